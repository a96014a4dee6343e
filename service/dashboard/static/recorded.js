// What the service has recorded of a stream: its events, or else the detections that are stored.

import { askJson } from "./api.js";
import { changed, pairsShown, state } from "./state.js";
import { moving } from "./words.js";

const can = { events: false, thumbnails: false };
let held = { of: null, things: [], error: null };

/** What this service offers, by its own description. */
export async function learnCapabilities() {
  const { paths } = await askJson("/openapi.json");
  can.events = "/events" in paths;
  can.thumbnails = "/detections/{detection_id}/thumbnail" in paths;
}

export const hasThumbnails = () => can.thumbnails;
export const hasEvents = () => can.events;

/** Things of the chosen stream, newest first: {key, title, score, from_ns, to_ns, at_ns, detection_id}. */
export const recorded = () => (held.of === state.selected ? held : { of: null, things: [], error: null });

/** Ask again; without a store there is nothing to ask for. */
export async function refreshRecorded() {
  const of = state.selected;
  if (!pairsShown().some((pair) => pair.detection_id)) return;
  const name = encodeURIComponent(of);
  try {
    const things = can.events
      ? thingsOf((await askJson(`/events?stream=${name}&limit=200`)).events)
      : (await askJson(`/detections?stream=${name}&label=independent_motion&limit=60`)).detections.map(storedThing);
    held = { of, things, error: null };
  } catch (error) {
    held = { of, things: [], error };
  }
  changed("recorded");
}

/** Start, updates and end of one track are one thing. */
function thingsOf(events) {
  const things = new Map();
  for (const event of [...events].reverse()) {
    const thing = things.get(event.thing_id) ?? { key: event.thing_id, title: `Track ${event.track_id}`, score: 0, from_ns: event.started_at_ns ?? event.timestamp_ns, to_ns: null, ended: null };
    things.set(event.thing_id, thing);
    thing.score = Math.max(thing.score, event.top_score ?? event.score);
    thing.at_ns = event.timestamp_ns;
    thing.detection_id = event.detection_id ?? thing.detection_id;
    if (event.kind === "end") [thing.to_ns, thing.ended] = [event.timestamp_ns, event.reason ?? "left"];
  }
  return [...things.values()].reverse();
}

function storedThing(one) {
  const best = moving(one.detection);
  const at = one.detection.source_timestamp_ns;
  return { key: one.id, title: `${best.length} moving`, score: Math.max(...best.map((roi) => roi.score)), from_ns: at, to_ns: at, at_ns: at, ended: null, detection_id: one.id };
}

/** The remembered pair nearest to a time of the camera, if the time is among theirs. */
export function pairAt(pairs, ns) {
  const stamps = pairs.map((pair) => pair.detection.source_timestamp_ns);
  if (!pairs.length || ns < stamps[0] - 1e9 || ns > stamps.at(-1) + 1e9) return -1;
  let best = 0;
  stamps.forEach((stamp, index) => { if (Math.abs(stamp - ns) < Math.abs(stamps[best] - ns)) best = index; });
  return best;
}
