// What moved, as a list: the service's events where it keeps any, else the tracks of the pairs that are remembered.

import { ask, askJson, inWords } from "./api.js";
import { h, onceAFrame } from "./dom.js";
import { lookAt, pairsShown, state, subscribe } from "./state.js";
import { isOpen } from "./tabs.js";
import { ago, counted, moving } from "./words.js";

const can = { events: false, thumbnails: false };
let stored = { of: null, items: null, kind: null };
const thumbnails = new Map();

/** What this service offers, by its own description. */
export async function learnCapabilities() {
  const { paths } = await askJson("/openapi.json");
  can.events = "/events" in paths;
  can.thumbnails = "/detections/{detection_id}/thumbnail" in paths;
}

/** Things that moved through these pairs, by the first place where they did. */
export function tracksOf(pairs) {
  const tracks = new Map();
  pairs.forEach((pair, index) => {
    for (const roi of moving(pair.detection)) {
      const key = `${pair.session_id} ${roi.track_id ?? `pair ${pair.number} ${roi.id}`}`;
      const found = tracks.get(key) ?? { key, id: roi.track_id, first: index, score: 0, pairs: 0 };
      found.last = index;
      found.pairs += 1;
      if (roi.score >= found.score) [found.score, found.best] = [roi.score, pair];
      tracks.set(key, found);
    }
  });
  return [...tracks.values()];
}

export function addEventsPanel(panel) {
  const now = h("ul", { class: "plain-list" });
  const before = h("div", {});
  panel.append(h("h3", {}, "Things that moved"), now, before);
  subscribe(onceAFrame(() => {
    if (!isOpen("events")) return;
    const tracks = tracksOf(pairsShown()).reverse();
    now.replaceChildren(...tracks.slice(0, 40).map(trackItem));
    if (!tracks.length) now.replaceChildren(h("li", { class: "quiet-note" }, "Nothing has moved by itself in the pairs that are remembered."));
    drawStored(before);
  }));
}

function trackItem(track) {
  return h("li", {}, h("button", { type: "button", class: "list-button", onclick: () => lookAt(track.best.number) },
    thumbnailOf(track.best.detection_id),
    h("span", { class: "grow" }, h("strong", {}, track.id === null ? "Without a track" : `Track ${track.id}`),
      h("span", { class: "muted" }, ` ${counted(track.pairs, "pair")}, best ${ago(track.best.received_at_ns)}`)),
    h("span", { class: "score" }, track.score.toFixed(2))));
}

async function drawStored(place) {
  const wanted = state.selected;
  const hasStore = pairsShown().some((pair) => pair.detection_id);
  if (stored.of === wanted || (!can.events && !hasStore)) return;
  stored = { of: wanted, items: null };
  const name = encodeURIComponent(wanted);
  try {
    const answer = can.events ? await askJson(`/events?stream=${name}&limit=50`) : await askJson(`/detections?stream=${name}&label=independent_motion&limit=50`);
    const items = can.events ? (answer.events ?? []).map(eventItem) : answer.detections.map(storedItem);
    place.replaceChildren(h("h3", {}, can.events ? "Recorded events" : "Stored detections"), h("ul", { class: "plain-list" }, items.length ? items : h("li", { class: "quiet-note" }, "None yet.")));
  } catch (error) {
    place.replaceChildren(h("p", { class: "quiet-note" }, inWords(error)));
  }
}

const eventItem = (event) => h("li", { class: "list-row" }, h("strong", {}, `${event.kind} `),
  h("span", { class: "grow muted" }, `track ${event.track_id ?? "none"} at ${(event.timestamp_ns / 1e9).toFixed(2)} s`),
  h("span", { class: "score" }, Number(event.score ?? 0).toFixed(2)));

function storedItem(one) {
  const best = Math.max(...moving(one.detection).map((roi) => roi.score));
  return h("li", { class: "list-row" }, thumbnailOf(one.id), h("span", { class: "grow" }, counted(moving(one.detection).length, "moving thing"),
    h("span", { class: "muted" }, ` ${ago(one.stored_at_ns)}`)), h("span", { class: "score" }, best.toFixed(2)));
}

function thumbnailOf(id) {
  if (!can.thumbnails || !id) return null;
  const image = h("img", { class: "thumbnail", alt: "", hidden: true });
  if (!thumbnails.has(id)) thumbnails.set(id, ask(`/detections/${id}/thumbnail`).then((r) => r.blob()).then((b) => URL.createObjectURL(b), () => null));
  thumbnails.get(id).then((url) => { if (url) { image.src = url; image.hidden = false; } });
  return image;
}
