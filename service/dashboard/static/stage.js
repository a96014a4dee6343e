// The chosen pair, large: the picture with its regions beside a map of what was made of it.

import { inWords, pairPath, picture, postJson } from "./api.js";
import { byId, h, onceAFrame } from "./dom.js";
import { Frame, labelSwatch, regionsSvg } from "./picture.js";
import { changed, currentDetection, currentPair, openRoi, state, subscribe } from "./state.js";
import { isOpen } from "./tabs.js";
import { ago, counted, isQuiet, moving, nameOfStream } from "./words.js";

let frame = null;
let map = null;
let asked = null;

const WIDE = 2; // pictures wider than this times their height lie below each other
const MAP_LEGENDS = {
  residual: ["inferno", "0", "80+ gray levels", "What the rebuilt picture gets wrong. Bright is unexplained."],
  evidence: ["viridis", "0", "1", "Probability that a pixel belongs to something that moves by itself."],
  flow: ["wheel", "", "", "Where the static world goes: colour is the direction, strength the length."],
};

export function addStage() {
  frame = new Frame(byId("picture"), "");
  map = new Frame(byId("map"), "", 350);
  byId("legend").append(
    h("span", {}, labelSwatch("independent_motion"), " independent motion"),
    h("span", {}, labelSwatch("model_error"), " model error"),
    h("span", { class: "muted" }, "#track score"));
  byId("show-rois").addEventListener("change", (event) => { state.showRois = event.target.checked; changed("view"); });
  byId("show-arrows").addEventListener("change", (event) => { state.showArrows = event.target.checked; changed("view"); });
  byId("map-kind").addEventListener("change", (event) => { state.mapKind = event.target.value; changed("view"); });
  document.addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || document.querySelector("dialog[open]") || state.roi === null) return;
    const id = state.roi;
    openRoi(null);
    requestAnimationFrame(() => requestAnimationFrame(() => document.getElementById(`roi-${id}`)?.focus()));
  });
  subscribe(onceAFrame(draw));
}

const inWordsOf = (load) => load.catch((error) => { error.words = inWords(error); throw error; });

function draw() {
  const pair = currentPair();
  if (!pair) return;
  const detection = currentDetection();
  byId("picture").closest(".panes").classList.toggle("wide", detection.image.width > WIDE * detection.image.height);
  byId("stage-title").textContent = nameOfStream(pair.stream_id);
  byId("stage-note").replaceChildren(...noteOf(pair, detection));
  drawPicture(pair, detection);
  drawMap(pair, detection);
  if (state.cursor !== null || state.showArrows || isOpen("tuner")) lookClosely(pair);
}

function noteOf(pair, detection) {
  const count = moving(detection).length;
  const quiet = isQuiet(pair.received_at_ns);
  const words = quiet ? ["thing moved", "things moved"] : ["thing moves", "things move"];
  const told = detection.status === "abstained" ? "this pair cannot be judged" : counted(count, ...words);
  const parts = [h("strong", { class: count && !quiet ? "hot" : "" }, told), ` · ${state.cursor === null ? "newest pair" : "held"}, ${ago(pair.received_at_ns)}`];
  if (state.tuned?.number === pair.number) parts.push(h("span", { class: "chip" }, "as tuned"));
  for (const reason of detection.reasons) parts.push(h("span", { class: "chip warn", title: reason.message }, reason.code.replaceAll("_", " ")));
  return parts;
}

function drawPicture(pair, detection) {
  frame.want(pair.number, () => inWordsOf(picture(pair, "source")), detection.image);
  frame.image.alt = describe(pair, detection);
  const look = state.inspection?.number === pair.number ? state.inspection : null;
  const ghosts = state.tuned?.number === pair.number ? gone(pair.detection, detection) : [];
  const shown = state.showRois ? detection : { ...detection, rois: [] };
  frame.draw(regionsSvg(shown, {
    chosen: state.roi,
    ghosts: state.showRois ? ghosts : [],
    arrows: state.showArrows && look?.flow_arrows ? look.flow_arrows : [],
    onChoose: openRoi,
  }));
}

/** Motion that was there as judged and is not under the tuner's options. */
function gone(before, after) {
  const same = (a, b) => Math.abs(a.bbox.x - b.bbox.x) + Math.abs(a.bbox.y - b.bbox.y) < 6;
  return moving(before).filter((roi) => !moving(after).some((other) => same(roi, other)));
}

function describe(pair, detection) {
  const things = moving(detection).map((roi) => {
    const across = (roi.bbox.x + roi.bbox.width / 2) / detection.image.width;
    const place = across < 1 / 3 ? "left" : across > 2 / 3 ? "right" : "middle";
    return `${roi.track_id === null ? "a region" : `track ${roi.track_id}`} in the ${place}, score ${roi.score.toFixed(2)}`;
  });
  return `Frame of ${nameOfStream(pair.stream_id)}: ${things.length ? `moving: ${things.join("; ")}` : "nothing moves by itself"}`;
}

function drawMap(pair, detection) {
  const kind = state.mapKind;
  map.want(`${pair.number} ${kind}`, () => inWordsOf(picture(pair, kind)), detection.image);
  const [ramp, low, high, told] = MAP_LEGENDS[kind];
  map.image.alt = `Map of the same frame. ${told}`;
  map.draw(state.showRois ? regionsSvg({ ...detection, rois: moving(detection) }, { labels: false, chosen: state.roi }) : null);
  byId("map-legend").replaceChildren(h("span", { class: "scale" }, low, h("span", { class: `ramp ${ramp}`, "aria-hidden": "true" }), high), h("span", { class: "muted" }, told));
}

/** Hypotheses and arrows of the pair at hand, asked for once it holds still. */
async function lookClosely(pair) {
  if (state.inspection?.number === pair.number || asked) return;
  asked = pair.number;
  try {
    const found = await postJson(`${pairPath(pair)}/inspect`, { view: true });
    state.inspection = { number: pair.number, ...found };
  } catch (error) {
    state.inspection = { number: pair.number, error: inWords(error) };
  }
  setTimeout(() => { asked = null; changed("inspection"); }, state.cursor === null ? 400 : 60);
}

