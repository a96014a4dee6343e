// The regions of the pair at hand, and why each carries its label.

import { picture } from "./api.js";
import { h, onceAFrame, s } from "./dom.js";
import { labelSwatch } from "./picture.js";
import { currentDetection, currentPair, openRoi, state, subscribe } from "./state.js";
import { isOpen } from "./tabs.js";
import { EVIDENCE, LABELS, counted, number, verdict } from "./words.js";

export function addRegionsPanel(panel) {
  const list = h("ul", { class: "plain-list", id: "roi-list" });
  const detail = h("section", { id: "roi-detail", "aria-live": "off" });
  const head = h("h3", {}, "Regions of this pair");
  const reasons = h("ul", { class: "reasons" });
  panel.append(head, reasons, list, detail);
  let shown = "";
  subscribe(onceAFrame(() => {
    const pair = currentPair();
    if (!isOpen("regions") || !pair) return;
    const detection = currentDetection();
    const look = state.inspection?.number === pair.number ? state.inspection : null;
    const key = [pair.number, state.roi, state.tuned?.number === pair.number, look !== null, state.detector !== null].join();
    if (key === shown) return;
    const focused = document.activeElement?.id;
    shown = key;
    reasons.replaceChildren(...detection.reasons.map((reason) => h("li", {}, h("strong", {}, reason.code.replaceAll("_", " ")), h("span", {}, reason.message))));
    list.replaceChildren(...detection.rois.map(roiItem));
    if (!detection.rois.length) list.replaceChildren(h("li", { class: "quiet-note" }, detection.status === "abstained" ? "This pair cannot be judged: the first of the reasons above decided that." : "No regions: everything here is explained by the camera's own motion."));
    const roi = detection.rois.find((one) => one.id === state.roi);
    detail.replaceChildren(...(roi ? detailOf(pair, detection, roi, look) : hypothesesOf(look)));
    if (focused?.startsWith("roi-")) document.getElementById(focused)?.focus();
  }));
}

function roiItem(roi) {
  const open = roi.id === state.roi;
  return h("li", {}, h("button", { type: "button", class: "list-button", id: `roi-${roi.id}`, "aria-expanded": String(open), "aria-controls": "roi-detail", onclick: () => openRoi(open ? null : roi.id) },
    labelSwatch(roi.label),
    h("span", { class: "grow" }, h("strong", {}, LABELS[roi.label]), h("span", { class: "muted" }, roi.track_id === null ? "" : ` track ${roi.track_id}`)),
    meter(roi.score, roi.label), h("span", { class: "score" }, roi.score.toFixed(2))));
}

const meter = (value, label) => s("svg", { viewBox: "0 0 60 8", width: 60, height: 8, class: `meter ${label}`, "aria-hidden": "true" },
  s("rect", { x: 0, y: 1, width: 60, height: 6, rx: 3, class: "track" }),
  s("rect", { x: 0, y: 1, width: Math.max(2, 60 * value), height: 6, rx: 3, class: "value" }));

function detailOf(pair, detection, roi, look) {
  const motionScore = state.detector?.configuration.regions.motion_score ?? 0.5;
  const crop = h("canvas", { class: "crop", role: "img", "aria-label": "The region in the picture" });
  drawCrop(crop, pair, detection, roi);
  return [
    h("div", { class: "detail-head" }, h("h3", {}, `Region ${roi.id}`), h("button", { type: "button", class: "small", onclick: () => openRoi(null) }, "Close")),
    h("div", { class: "detail-top" }, crop, h("p", { class: "verdict" }, verdict(roi, motionScore))),
    h("table", { class: "facts" }, h("caption", {}, "Evidence"), h("tbody", {}, ...shapeRows(roi), ...evidenceRows(roi))),
    ...hypothesesOf(look),
  ];
}

const row = (name, value, unit, told) => h("tr", {}, h("th", { scope: "row" }, name, told ? h("span", { class: "muted" }, told) : null), h("td", {}, value, unit ? h("span", { class: "unit" }, ` ${unit}`) : null));

function shapeRows(roi) {
  const { x, y, width, height } = roi.bbox;
  return [
    row("Box", `${width} × ${height}`, "px", `from ${x}, ${y}`),
    row("Area", number(roi.area_px, 0), "px", "of the region's own pixels"),
    row("Thickness", number(roi.thickness_px, 1), "px", "of the largest disc inside"),
    row("Residual", `${number(roi.residual_mean, 1)} / ${number(roi.residual_max, 0)}`, "gray", "mean and largest"),
  ];
}

function evidenceRows(roi) {
  return Object.entries(roi.evidence).filter(([name]) => name !== "rule").map(([name, value]) => {
    const [words, unit, told] = EVIDENCE[name] ?? [name.replaceAll("_", " "), "", ""];
    return row(words, typeof value === "number" ? number(value) : String(value), unit, told);
  });
}

async function drawCrop(canvas, pair, detection, roi) {
  const image = new Image();
  try {
    image.src = await picture(pair, "source");
    await image.decode();
  } catch {
    canvas.hidden = true;
    return;
  }
  const room = 1.6;
  const side = Math.max(roi.bbox.width, roi.bbox.height, 24) * room;
  const [cx, cy] = [roi.bbox.x + roi.bbox.width / 2, roi.bbox.y + roi.bbox.height / 2];
  const [left, top] = [cx - side / 2, cy - side / 2];
  canvas.width = canvas.height = 240;
  const scale = canvas.width / side;
  const pen = canvas.getContext("2d");
  pen.imageSmoothingEnabled = false;
  pen.drawImage(image, left, top, side, side, 0, 0, canvas.width, canvas.height);
  const styles = getComputedStyle(document.documentElement);
  pen.lineWidth = 4;
  pen.strokeStyle = styles.getPropertyValue(roi.label === "independent_motion" ? "--motion-mark" : "--band-mark");
  if (roi.label === "model_error") pen.setLineDash([10, 7]);
  pen.strokeRect((roi.bbox.x - left) * scale, (roi.bbox.y - top) * scale, roi.bbox.width * scale, roi.bbox.height * scale);
}

/** How well each of the network's guesses rebuilds the frame; the best one won. */
function hypothesesOf(look) {
  if (look?.error) return [h("p", { class: "quiet-note" }, look.error)];
  if (!look?.hypotheses) return [h("p", { class: "quiet-note" }, "Stop at a pair (arrow keys on the timeline) to see the network's hypotheses.")];
  const { errors, winner, corrected_error: corrected } = look.hypotheses;
  const most = Math.max(...errors.map((error) => error ?? 0), corrected ?? 0) || 1;
  const bars = errors.map((error, index) => [`${index + 1}`, error, index === winner ? "won" : ""]);
  if (corrected !== null) bars.push(["corrected", corrected, "after"]);
  const told = `${counted(errors.length, "guess", "guesses")} of the camera's motion: number ${winner + 1} rebuilds the frame best` + (corrected === null ? "." : `, and the correction on the target image goes on from it.`);
  return [h("h3", {}, "Hypotheses"), h("p", { class: "muted" }, `${told} Bars are the mean error of the rebuilt frame, in standard deviations (σ) of its brightness; shorter is better.`),
    h("ul", { class: "bars", "aria-label": "Error of each hypothesis in standard deviations, smaller is better" }, ...bars.map(([name, error, kind]) => {
      const bar = h("span", { class: "bar-fill", "aria-hidden": "true" });
      bar.style.setProperty("--share", String((error ?? 0) / most));
      return h("li", { class: kind }, h("span", { class: "bar-name" }, name, kind === "won" ? h("span", { class: "chip" }, "won") : null), h("span", { class: "bar-room" }, bar), h("span", { class: "score" }, number(error, 3), error === null ? null : h("span", { class: "unit" }, " σ")));
    }))];
}

