// Thresholds and shape rule, tried on recorded pairs: the effect on this pair at once, then on the last ones.

import { inWords, pairPath, postJson } from "./api.js";
import { copyButton, h, onceAFrame, s } from "./dom.js";
import { changed, currentPair, pairsShown, state, subscribe } from "./state.js";
import { isOpen } from "./tabs.js";
import { counted, moving } from "./words.js";

const DEBOUNCE_MS = 120;
const TRIED_PAIRS = 16;
const FIELDS = {
  motion_score: ["Motion from this score on", 0.5, 1.01, 0.01],
  min_motion_probability: ["A pixel takes part from", 0.01, 0.99, 0.01],
  faint_motion_probability: ["Faint things from", 0.01, 0.99, 0.01],
  min_area_fraction: ["Smallest area", 0, 0.02, 0.0002],
  max_aspect_ratio: ["Longest over shortest side", 1, 20, 0.5],
  min_motion_extent_fraction: ["Narrowest side", 0, 0.15, 0.002],
};
const RESIDUAL_FIELDS = {
  threshold_mads: ["Threshold over the background", 1, 30, 0.5],
  min_residual_gray: ["Least residual", 0, 60, 0.5],
  min_area_fraction: FIELDS.min_area_fraction,
  max_aspect_ratio: FIELDS.max_aspect_ratio,
  min_x_extent_fraction: ["Narrowest, left to right", 0, 0.15, 0.002],
  min_y_extent_fraction: ["Narrowest, top to bottom", 0, 0.15, 0.002],
};
const RULES = { axis_aligned: "sides of the box (the paper's)", oriented: "sides of a turned box", thickness: "largest disc inside", none: "every shape passes" };

const controls = new Map();
let options = {};
let result = null;
let failed = null; // {number, error}: not asked again for the same pair until a setting changes
let trial = { after: [], running: false };
let controller = null;
let timer = null;
let form, effect, output;

export function addTuner(panel) {
  form = h("div", { class: "fields" });
  effect = h("div", { class: "effect", role: "status" });
  output = h("div", { class: "configuration", hidden: true });
  panel.append(h("h3", {}, "Try other settings"),
    h("p", { class: "muted" }, "Nothing changes in the service: pairs that it remembers are judged anew."),
    effect, output, form);
  subscribe((what) => { if (what === "detector") build(); });
  const draw = onceAFrame(() => {
    if (!isOpen("tuner") || !state.detector) return;
    const pair = currentPair();
    if (Object.keys(options).length && pair && state.cursor !== null && state.tuned?.number !== pair.number && failed?.number !== pair.number) schedule();
    drawEffect();
  });
  subscribe(draw);
}

function build() {
  if (!state.detector) return;
  const current = state.detector.configuration.regions;
  const residualOnly = state.detector.configuration.evidence === "residual";
  const fields = residualOnly ? { motion_score: FIELDS.motion_score, ...RESIDUAL_FIELDS } : FIELDS;
  const rule = h("select", { id: "tune-shape_rule" }, ...Object.entries(RULES).map(([value, label]) => h("option", { value, selected: value === current.shape_rule }, label)));
  rule.addEventListener("change", () => set("shape_rule", rule.value));
  controls.clear();
  controls.set("shape_rule", { input: rule });
  form.replaceChildren(
    ...Object.entries(fields).map(([name, about]) => slider(name, about, current[name])),
    h("div", { class: "field" }, h("label", { for: "tune-shape_rule" }, "Shape rule"), rule, h("p", { class: "muted" }, "what tells a thing from a narrow band, which is model error")),
    h("button", { type: "button", class: "small", id: "tune-reset", onclick: reset }, "As it was"));
}

function slider(name, [label, least, most, step], value) {
  const input = h("input", { type: "range", id: `tune-${name}`, min: least, max: most, step, value, "aria-describedby": `told-${name}` });
  const exact = h("input", { type: "number", min: least, max: most, step: "any", value, "aria-label": `${label}, exact` });
  const was = Number(value);
  input.addEventListener("input", () => { exact.value = input.value; set(name, Number(input.value)); });
  exact.addEventListener("change", () => { if (exact.reportValidity()) { input.value = exact.value; set(name, Number(exact.value)); } });
  controls.set(name, { input, exact });
  const told = state.detector.region_settings[name]?.description ?? "";
  return h("div", { class: "field" }, h("label", { for: `tune-${name}` }, label), h("span", { class: "row" }, input, exact), h("p", { class: "muted", id: `told-${name}` }, `${told ? `${told}; ` : ""}now ${was}`));
}

function set(name, value) {
  options[name] = value; // the stream may have options of its own: the service says what differs
  const pair = currentPair();
  if (pair) state.cursor = pair.number; // what is tuned holds still
  schedule();
}

function reset() {
  for (const [name, { input, exact }] of controls) {
    input.value = state.detector.configuration.regions[name];
    if (exact) exact.value = input.value;
  }
  options = {};
  schedule();
}

function schedule() {
  failed = null;
  clearTimeout(timer);
  timer = setTimeout(run, DEBOUNCE_MS);
}

async function run() {
  controller?.abort();
  controller = new AbortController();
  const { signal } = controller;
  const pair = currentPair();
  if (!pair) return;
  if (!Object.keys(options).length) {
    [result, state.tuned, trial] = [null, null, { after: [], running: false }];
    changed("tuned");
    return;
  }
  const body = { options: { regions: { ...options } }, view: false };
  trial = { after: [], running: true };
  try {
    result = await postJson(`${pairPath(pair)}/inspect`, body, signal);
    state.tuned = { number: pair.number, detection: withTracks(result.detection, pair.detection) };
    changed("tuned");
    for (const other of pairsShown().slice(-TRIED_PAIRS)) {
      const found = other.number === pair.number ? result : await postJson(`${pairPath(other)}/inspect`, body, signal).catch((error) => { if (error.name === "AbortError") throw error; return null; });
      trial.after.push({ pair: other, count: found ? moving(found.detection).length : null });
      drawEffect();
    }
  } catch (error) {
    if (error.name === "AbortError") return;
    failed = { number: pair.number, error };
  }
  trial.running = false;
  drawEffect();
}

/** One pair alone has no tracks; a region at the same place keeps the number that the stream gave it. */
function withTracks(detection, before) {
  const rois = detection.rois.map((roi) => {
    const same = before.rois.find((one) => Math.abs(one.bbox.x - roi.bbox.x) + Math.abs(one.bbox.y - roi.bbox.y) < 6);
    return same ? { ...roi, track_id: same.track_id } : roi;
  });
  return { ...detection, rois };
}

function drawEffect() {
  const pair = currentPair();
  output.hidden = !result?.configuration.toml;
  if (failed) {
    effect.replaceChildren(h("p", { class: "error" }, inWords(failed.error)));
    return;
  }
  if (!result || !pair) {
    effect.replaceChildren(h("p", { class: "quiet-note" }, "Move a slider: the picture shows at once what would change."));
    return;
  }
  const [before, after] = [moving(pair.detection).length, moving(result.detection).length];
  const tried = trial.after.filter((one) => one.count !== null);
  const [was, now] = [tried.reduce((sum, one) => sum + moving(one.pair.detection).length, 0), tried.reduce((sum, one) => sum + one.count, 0)];
  effect.replaceChildren(
    h("p", {}, "This pair: ", h("strong", {}, `${before} → ${after}`), ` regions of motion`),
    h("p", { class: "muted" }, `Last ${counted(tried.length, "pair")}${trial.running ? ", still counting" : ""}: ${was} → ${now} regions of motion`),
    bars(tried));
  const toml = h("pre", { tabindex: 0, "aria-label": "Configuration file" }, result.configuration.toml);
  const shell = h("pre", { tabindex: 0, "aria-label": "Environment variables" }, result.configuration.environment);
  if (output.dataset.shown === result.configuration.toml) return;
  output.dataset.shown = result.configuration.toml;
  output.replaceChildren(
    h("div", { class: "detail-head" }, h("h4", {}, "Configuration file"), copyButton(() => result.configuration.toml)), toml,
    h("div", { class: "detail-head" }, h("h4", {}, "or environment"), copyButton(() => result.configuration.environment)), shell);
}

/** Outlined: as judged. Filled: as tuned. */
function bars(tried) {
  const most = Math.max(1, ...tried.map((one) => Math.max(one.count, moving(one.pair.detection).length)));
  const [width, height] = [320, 48];
  const step = width / TRIED_PAIRS;
  const svg = s("svg", { viewBox: `0 0 ${width} ${height}`, class: "trial", role: "img", "aria-label": "Regions of motion of each tried pair, before and after" });
  tried.forEach((one, index) => {
    const [old, fresh] = [moving(one.pair.detection).length, one.count].map((count) => (count / most) * (height - 6));
    svg.append(s("rect", { x: index * step + 2, y: height - 2 - fresh, width: step - 5, height: fresh + 1, class: "after" }),
      s("rect", { x: index * step + 2, y: height - 2 - old, width: step - 5, height: old + 1, class: "before" }));
  });
  return svg;
}
