// Time from left to right: how strongly each pair says motion, the tracks below, and a slider to scrub.

import { byId, h, onceAFrame, s } from "./dom.js";
import { tracksOf } from "./events_panel.js";
import { pairAt, recorded } from "./recorded.js";
import { currentPair, lookAt, pairsShown, state, subscribe } from "./state.js";
import { counted, moving } from "./words.js";

const W = 1000;
const BARS = 74;
const LANE = 9;
const MOST_LANES = 5;
const THING = 12;
const CORNER = 10;
const LEAST_SLOTS = 40; // a few pairs begin at the left and leave room

let slider, picture, live, told;

export function addTimeline() {
  slider = h("input", { type: "range", id: "scrub", min: 0, max: 0, value: 0, step: 1 });
  live = h("button", { type: "button", class: "small", id: "go-live", onclick: () => lookAt(null) }, "Follow live");
  told = h("output", { for: "scrub", class: "muted", id: "scrub-told" });
  picture = h("div", { class: "timeline-picture" });
  const step = (by, label, sign) => h("button", { type: "button", class: "small", "aria-label": label, onclick: () => move(by) }, sign);
  byId("timeline").append(
    h("div", { class: "timeline-head" },
      h("label", { for: "scrub" }, "Timeline"), told,
      h("span", { class: "row" }, step(-1, "One pair back", "‹"), step(1, "One pair on", "›"), live)),
    picture, slider);
  slider.addEventListener("input", () => lookAt(pairsShown()[Number(slider.value)]?.number ?? null));
  picture.addEventListener("pointerdown", (event) => scrubTo(event));
  picture.addEventListener("pointermove", (event) => { if (event.buttons) scrubTo(event); });
  subscribe(onceAFrame(draw));
}

function move(by) {
  const pairs = pairsShown();
  const at = pairs.indexOf(currentPair());
  const next = pairs[Math.max(0, Math.min(pairs.length - 1, at + by))];
  if (next) lookAt(next.number);
}

function scrubTo(event) {
  const pairs = pairsShown();
  const bounds = picture.getBoundingClientRect();
  const share = (event.clientX - bounds.left) / bounds.width;
  const at = Math.max(0, Math.min(pairs.length - 1, Math.floor(share * slots(pairs))));
  if (pairs[at]) lookAt(pairs[at].number);
}

const slots = (pairs) => Math.max(pairs.length, LEAST_SLOTS);

function draw() {
  const pairs = pairsShown();
  const pair = currentPair();
  if (!pair) return;
  const at = pairs.indexOf(pair);
  slider.max = String(pairs.length - 1);
  slider.value = String(at);
  slider.style.setProperty("width", `max(48px, ${(100 * pairs.length) / slots(pairs)}%)`);
  const count = moving(pair.detection).length;
  const words = `pair ${at + 1} of ${pairs.length}, ${counted(count, "moving thing")}`;
  slider.setAttribute("aria-valuetext", words);
  told.textContent = words;
  live.setAttribute("aria-pressed", String(state.cursor === null));
  picture.replaceChildren(svgOf(pairs, at));
}

function svgOf(pairs, at) {
  const tracks = tracksOf(pairs).slice(-MOST_LANES);
  const height = BARS + 6 + Math.max(1, tracks.length) * LANE;
  const step = W / slots(pairs);
  const svg = s("svg", { viewBox: `0 0 ${W} ${height}`, preserveAspectRatio: "none", "aria-hidden": "true" });
  svg.append(s("line", { x1: 0, x2: W, y1: BARS, y2: BARS, class: "axis" }));
  svg.append(s("rect", { x: at * step, y: 0, width: Math.max(step, 2), height, class: "cursor" }));
  pairs.forEach((pair, index) => svg.append(...mark(pair, index * step, step)));
  tracks.forEach((track, lane) => {
    const y = BARS + 6 + lane * LANE;
    svg.append(s("rect", { x: track.first * step, y, width: Math.max((track.last - track.first + 1) * step - 1, 3), height: LANE - 3, rx: 2, class: "lane" }));
  });
  for (const thing of recorded().things) svg.append(...thingMarks(pairs, thing, step));
  return svg;
}

/** A full triangle where a recorded thing began, an open one where it ended. */
function thingMarks(pairs, thing, step) {
  return [[thing.from_ns, "began"], [thing.to_ns, "ended"]].filter(([ns, kind]) => ns !== null && (kind === "began" || thing.to_ns !== thing.from_ns))
    .map(([ns, kind]) => [pairAt(pairs, ns), kind]).filter(([at]) => at >= 0)
    .map(([at, kind]) => s("path", { d: `M${thingLeft(at, step)} 2h${THING}l-6 9z`, class: `thing ${kind}` }));
}

/** Above the middle of its pair, but clear of the picture's round corners. */
const thingLeft = (at, step) => Math.min(Math.max((at + 0.5) * step - THING / 2, CORNER), W - THING - CORNER);

function mark(pair, x, step) {
  const width = Math.max(step * 0.72, 1);
  if (pair.detection.status === "abstained") return [s("rect", { x, y: BARS - 12, width, height: 12, class: "abstained" })];
  const best = Math.max(0, ...moving(pair.detection).map((roi) => roi.score));
  const marks = [];
  if (best) marks.push(s("rect", { x, y: BARS * (1 - best) + 2, width, height: BARS * best - 2, rx: Math.min(2, width / 3), class: "bar" }));
  else marks.push(s("rect", { x, y: BARS - 2, width, height: 2, class: "quiet" }));
  return marks;
}
