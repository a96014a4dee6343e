// Says new motion to screen readers, but not more often than a person can bear.

import { byId } from "./dom.js";
import { counted, moving, nameOfStream } from "./words.js";

const QUIET_MS = 6000;
const known = new Map(); // stream and session -> tracks that were told
let pending = new Map();
let last = 0;
let timer = null;

export function say(text) {
  byId("announcer").textContent = text;
}

export function noteMotion(pair) {
  const session = `${pair.stream_id} ${pair.session_id}`;
  const told = known.get(session) ?? new Set();
  known.set(session, told);
  const fresh = moving(pair.detection).filter((roi) => roi.track_id === null || !told.has(roi.track_id));
  if (!fresh.length) return;
  for (const roi of fresh) if (roi.track_id !== null) told.add(roi.track_id);
  pending.set(pair.stream_id, (pending.get(pair.stream_id) ?? 0) + fresh.length);
  timer ??= setTimeout(tell, Math.max(300, last + QUIET_MS - Date.now()));
}

function tell() {
  timer = null;
  last = Date.now();
  const parts = [...pending].map(([id, count]) => `${counted(count, "new moving thing")} in ${nameOfStream(id)}`);
  pending = new Map();
  say(parts.join("; "));
}
