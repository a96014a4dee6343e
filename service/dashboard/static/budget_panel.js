// Alarms an hour: what is raised now, and what the calibration promised.

import { copyButton, h, onceAFrame, s } from "./dom.js";
import { state, subscribe } from "./state.js";
import { isOpen } from "./tabs.js";
import { nameOfStream } from "./words.js";

const COMMAND = "viflow-anomaly calibrate RECORDING... \\\n  --false-alarms-per-hour 10 --out hall.json\nviflow-anomaly serve --calibration hall.json";
const LEAST_FOOTAGE_S = 60; // one alarm in half a second would be 7,200 an hour
const rounded = (value) => (value >= 100 ? Math.round(value).toLocaleString() : Number(value.toPrecision(3)).toString());

export function addBudgetPanel(panel) {
  const promise = h("div", {});
  const streams = h("div", {});
  panel.append(h("h3", {}, "False-alarm budget"), promise, h("h3", {}, "Raised now"), streams);
  subscribe(onceAFrame(() => {
    if (!isOpen("budget") || !state.detector) return;
    promise.replaceChildren(...promised(state.detector.calibration));
    streams.replaceChildren(...raised(state.detector.calibration?.budget_per_hour ?? null));
  }));
}

function promised(found) {
  if (!found) {
    const score = state.detector.configuration.regions.motion_score;
    return [h("p", {}, `No calibration is loaded: the threshold is ${score}, and nobody has said how many false alarms it gives. Footage in which nothing moves by itself says it:`),
      h("pre", { tabindex: 0 }, COMMAND), copyButton(COMMAND)];
  }
  const sure = `${Math.round(found.confidence * 100)} %`;
  return [
    h("p", { class: "big" }, h("strong", {}, rounded(found.budget_per_hour)), " false alarms an hour are allowed"),
    h("p", {}, found.promised ? `With the threshold ${found.motion_score} there are fewer, with ${sure} confidence.` : `The footage was too short to promise that; with ${sure} confidence there are at most ${rounded(found.bound_per_hour)}.`),
    h("p", { class: "muted" }, `Found on ${rounded(found.hours)} hours, ${found.pairs.toLocaleString()} pairs (${found.recordings.slice(0, 4).join(", ")}), ${found.created.slice(0, 10)}; ${rounded(found.expected_per_hour)} an hour are expected.`),
  ];
}

function raised(budget) {
  const rows = [...state.streams.values()].filter((stream) => stream.overview?.alarms_per_hour != null);
  if (!rows.length) return [h("p", { class: "quiet-note" }, "No judged footage yet.")];
  const told = rows.filter(({ overview }) => saysRate(overview)).map(({ overview }) => overview.alarms_per_hour);
  const most = Math.max(budget ?? 0, ...told, 1);
  return [h("p", { class: "muted" }, "Regions labelled as motion, each pair counted, an hour of judged footage; true ones are among them. Bars are logarithmic."),
    h("ul", { class: "plain-list" }, ...rows.map((stream) => rate(stream, budget, most))),
    h("p", { class: "muted" }, "A rate of a few minutes says little yet.")];
}

const saysRate = (overview) => overview.footage_s >= LEAST_FOOTAGE_S;

function rate({ id, overview }, budget, most) {
  const name = [h("strong", {}, nameOfStream(id)), h("span", { class: "muted" }, ` ${overview.footage_s.toFixed(1)} s of footage`)];
  if (!saysRate(overview)) {
    return h("li", { class: "rate" }, h("span", { class: "list-row" }, h("span", { class: "grow" }, ...name),
      h("span", { class: "muted" }, "less than 1 minute of footage "), h("span", { class: "score" }, "–")));
  }
  const share = (value) => (value > 0 ? Math.max(0.02, Math.log1p(value) / Math.log1p(most)) : 0);
  return h("li", { class: "rate" },
    h("span", { class: "list-row" }, h("span", { class: "grow" }, ...name), h("span", { class: "score" }, `${rounded(overview.alarms_per_hour)}/h`)),
    s("svg", { viewBox: "0 0 300 10", class: "rate-bar", preserveAspectRatio: "none", "aria-hidden": "true" },
      s("rect", { x: 0, y: 1, width: 300, height: 8, class: "track" }),
      s("rect", { x: 0, y: 1, width: 300 * share(overview.alarms_per_hour), height: 8, class: "value" }),
      budget ? s("rect", { x: 300 * share(budget) - 1, y: 0, width: 2, height: 10, class: "mark" }) : ""));
}
