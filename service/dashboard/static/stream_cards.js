// One card a stream: the live picture, what moves in it, how often it alarms.

import { inWords, picture } from "./api.js";
import { byId, h, onceAFrame } from "./dom.js";
import { Frame, regionsSvg } from "./picture.js";
import { select, state, subscribe } from "./state.js";
import { ago, counted, isQuiet, moving, nameOfStream } from "./words.js";

const cards = new Map();

export function addCards() {
  const draw = onceAFrame(drawCards);
  subscribe(draw);
  setInterval(draw, 2000);
}

function drawCards() {
  const list = byId("stream-cards");
  list.classList.toggle("alone", cards.size === 1);
  for (const [id, card] of cards) {
    if (!state.streams.get(id)?.pairs.length) {
      card.item.remove();
      cards.delete(id);
    }
  }
  for (const stream of state.streams.values()) {
    if (!stream.pairs.length) continue;
    let card = cards.get(stream.id);
    if (!card) {
      card = newCard(stream.id);
      cards.set(stream.id, card);
      list.append(card.item);
    }
    updateCard(card, stream);
  }
}

function newCard(id) {
  const place = h("span", { class: "frame" });
  const title = h("span", { class: "card-title" }, nameOfStream(id));
  const status = h("span", { class: "card-status" });
  const numbers = h("span", { class: "card-numbers" });
  const button = h("button", { type: "button", class: "card", onclick: () => select(id) },
    place, h("span", { class: "card-text-block" }, h("span", { class: "card-line" }, title, status), numbers));
  return { item: h("li", {}, button), button, status, numbers, frame: new Frame(place, "") };
}

function updateCard(card, stream) {
  const pair = stream.pairs.at(-1);
  const { detection } = pair;
  const count = moving(detection).length;
  card.button.setAttribute("aria-pressed", String(state.selected === stream.id));
  card.frame.want(pair.number, () => picture(pair, "source").catch((error) => { error.words = inWords(error); throw error; }));
  card.frame.draw(regionsSvg(detection, { labels: false, fit: "xMidYMid meet" }));
  const active = Date.now() / 1000 - pair.received_at_ns / 1e9 < 3;
  card.status.textContent = active ? "live" : ago(pair.received_at_ns);
  card.status.dataset.active = active;
  const quiet = isQuiet(pair.received_at_ns);
  const tracks = new Set(stream.pairs.flatMap((one) => moving(one.detection).map((roi) => roi.track_id)).filter((id) => id !== null)).size;
  const told = detection.status === "abstained" ? "not judged" : (count ? `${count} ${quiet ? "moved" : "moving"}` : "no motion");
  card.numbers.replaceChildren(
    h("span", { class: count && !quiet ? "hot" : "" }, told),
    h("span", {}, `${counted(stream.overview?.judged_pairs ?? stream.pairs.length, "pair")}`),
    tracks ? h("span", {}, counted(tracks, "track")) : "",
  );
}
