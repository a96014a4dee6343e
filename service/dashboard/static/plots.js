// Small plots over time: lines, a band of one sigma, and words for who does not see them.

import { h, s } from "./dom.js";

const W = 360;
const H = 110;
const LEFT = 44;
const BOTTOM = 18;

/**
 * series: [{label, dash, points: [[x, y, sigma?], ...]}]; x in seconds. Gaps where y is null.
 * limits: horizontal lines [[y, label]].
 */
export function linePlot(title, unit, series, { limits = [], zero = false } = {}) {
  const points = series.flatMap((one) => one.points.filter(([, y]) => y !== null && y !== undefined));
  const told = points.length ? `latest ${series.map((one) => latest(one, unit)).filter(Boolean).join(", ")}` : "no values yet";
  const head = h("div", { class: "plot-head" }, h("h4", {}, title), h("span", { class: "muted" }, told));
  if (points.length < 2) return h("div", { class: "plot" }, head);
  const xs = points.map(([x]) => x);
  const ys = points.flatMap(([, y, sigma]) => (sigma ? [y - sigma, y + sigma] : [y]));
  ys.push(...limits.map(([y]) => y));
  if (zero) ys.push(0);
  const [x0, x1] = [Math.min(...xs), Math.max(...xs)];
  let [y0, y1] = [Math.min(...ys), Math.max(...ys)];
  const room = (y1 - y0 || Math.abs(y1) || 1) * 0.08;
  [y0, y1] = [y0 - (zero && y0 === 0 ? 0 : room), y1 + room];
  const px = (x) => LEFT + ((x - x0) / (x1 - x0 || 1)) * (W - LEFT - 6);
  const py = (y) => 6 + (1 - (y - y0) / (y1 - y0)) * (H - BOTTOM - 6);
  const svg = s("svg", { viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": `${title}, ${unit}: ${told}` });
  for (const y of [y0, (y0 + y1) / 2, y1]) {
    svg.append(s("line", { x1: LEFT, x2: W - 6, y1: py(y), y2: py(y), class: "grid" }), s("text", { x: LEFT - 5, y: py(y) + 3.5, class: "tick end" }, short(y)));
  }
  svg.append(s("text", { x: LEFT, y: H - 4, class: "tick" }, `${short(x0 - x1)} s`), s("text", { x: W - 6, y: H - 4, class: "tick end" }, "now"));
  for (const [y, label] of limits) svg.append(s("line", { x1: LEFT, x2: W - 6, y1: py(y), y2: py(y), class: "limit" }), s("text", { x: W - 8, y: py(y) - 3, class: "tick end" }, label));
  series.forEach((one, index) => {
    const known = one.points.filter(([, y]) => y !== null && y !== undefined);
    if (known.some(([, , sigma]) => sigma)) {
      const up = known.map(([x, y, sigma]) => `${px(x)},${py(y + (sigma ?? 0))}`);
      const down = known.map(([x, y, sigma]) => `${px(x)},${py(y - (sigma ?? 0))}`).reverse();
      svg.append(s("polygon", { points: [...up, ...down].join(" "), class: `band series-${index}` }));
    }
    svg.append(s("polyline", { points: known.map(([x, y]) => `${px(x)},${py(y)}`).join(" "), class: `series series-${index}` }));
  });
  const key = series.length > 1 ? h("p", { class: "key" }, ...series.map((one, index) => h("span", {}, s("svg", { viewBox: "0 0 20 6", width: 20, height: 6, "aria-hidden": "true" }, s("line", { x1: 0, x2: 20, y1: 3, y2: 3, class: `series series-${index}` })), ` ${one.label}`))) : null;
  return h("div", { class: "plot" }, head, svg, key);
}

function latest(one, unit) {
  const last = one.points.filter(([, y]) => y !== null && y !== undefined).at(-1);
  if (!last) return "";
  const sigma = last[2] ? ` ± ${short(last[2])}` : "";
  return `${one.label ? `${one.label} ` : ""}${short(last[1])}${sigma}${unit ? ` ${unit}` : ""}`;
}

function short(value) {
  const size = Math.abs(value);
  if (size === 0) return "0";
  if (size >= 100) return value.toFixed(0);
  if (size >= 1) return value.toFixed(size >= 10 ? 1 : 2);
  return Number(value.toPrecision(2)).toString();
}
