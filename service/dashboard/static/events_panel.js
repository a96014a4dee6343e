// What moved, as a list: what the service has recorded, and the tracks of the pairs that are remembered.

import { ask, inWords } from "./api.js";
import { h, onceAFrame } from "./dom.js";
import { hasEvents, hasThumbnails, pairAt, recorded, refreshRecorded } from "./recorded.js";
import { lookAt, pairsShown, subscribe } from "./state.js";
import { isOpen } from "./tabs.js";
import { ago, counted, moving } from "./words.js";

const thumbnails = new Map();

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
  subscribe((what) => { if (["selected", "detector", "overview"].includes(what)) refreshRecorded(); });
  subscribe(onceAFrame(() => {
    if (!isOpen("events")) return;
    const tracks = tracksOf(pairsShown()).reverse();
    now.replaceChildren(...tracks.slice(0, 40).map(trackItem));
    if (!tracks.length) now.replaceChildren(h("li", { class: "quiet-note" }, "Nothing has moved by itself in the pairs that are remembered."));
    before.replaceChildren(...recordedItems());
  }));
}

function trackItem(track) {
  return h("li", {}, h("button", { type: "button", class: "list-button", onclick: () => lookAt(track.best.number) },
    thumbnailOf(track.best.detection_id),
    h("span", { class: "grow" }, h("strong", {}, track.id === null ? "Without a track" : `Track ${track.id}`),
      h("span", { class: "muted" }, ` ${counted(track.pairs, "pair")}, best ${ago(track.best.received_at_ns)}`)),
    h("span", { class: "score" }, track.score.toFixed(2))));
}

function recordedItems() {
  const { of, things, error } = recorded();
  if (of === null) return [];
  const head = h("h3", {}, hasEvents() ? "Recorded events" : "Stored detections");
  if (error) return [head, h("p", { class: "quiet-note" }, inWords(error))];
  if (!things.length) return [head, h("p", { class: "quiet-note" }, "None yet.")];
  return [head, h("ul", { class: "plain-list" }, ...things.map(thingItem))];
}

function thingItem(thing) {
  const pairs = pairsShown();
  const at = pairAt(pairs, thing.at_ns);
  const seconds = thing.to_ns === null ? "still there" : `${((thing.to_ns - thing.from_ns) / 1e9).toFixed(2)} s`;
  const content = [thumbnailOf(thing.detection_id), h("span", { class: "grow" }, h("strong", {}, thing.title),
    h("span", { class: "muted" }, ` ${thing.to_ns === thing.from_ns ? "" : seconds}${thing.ended ? `, ${thing.ended.replaceAll("_", " ")}` : ""}`)),
  h("span", { class: "score" }, thing.score.toFixed(2))];
  if (at < 0) return h("li", { class: "list-row" }, ...content);
  return h("li", {}, h("button", { type: "button", class: "list-button", onclick: () => lookAt(pairs[at].number) }, ...content));
}

function thumbnailOf(id) {
  if (!hasThumbnails() || !id) return null;
  const image = h("img", { class: "thumbnail", alt: "", hidden: true });
  if (thumbnails.size > 400) thumbnails.clear();
  if (!thumbnails.has(id)) thumbnails.set(id, ask(`/detections/${id}/thumbnail`).then((r) => r.blob()).then((b) => URL.createObjectURL(b)).catch(() => null));
  thumbnails.get(id).then((url) => { if (url) { image.src = url; image.hidden = false; } });
  return image;
}
