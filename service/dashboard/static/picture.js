// The picture with its regions: an image below, an SVG in the source image's pixels above.

import { h, s } from "./dom.js";
import { LABELS } from "./words.js";

const byWeight = (a, b) => (a.label === b.label ? a.score - b.score : a.label === "independent_motion" ? 1 : -1);

/** Keeps one frame up to date; the newest wanted picture wins, and one is fetched at a time. */
export class Frame {
  constructor(place, label, rest = 80) {
    this.rest = rest; // ms between two pictures: a viewer must not keep the service busy
    this.image = h("img", { alt: label, decoding: "async" });
    this.overlay = h("div", { class: "overlay" });
    this.note = h("p", { class: "frame-note", hidden: true });
    this.busy = false;
    this.next = null;
    place.replaceChildren(this.image, this.overlay, this.note);
    this.place = place;
  }

  /** load(): a promise of an address. */
  want(key, load, size) {
    if (size) this.place.style.setProperty("--ratio", `${size.width} / ${size.height}`);
    if (key === this.shown || key === this.loading || document.hidden) return;
    if (key === this.failed && Date.now() < this.again) return;
    this.next = { key, load };
    this.pump();
  }

  async pump() {
    if (this.busy || !this.next) return;
    const { key, load } = this.next;
    this.next = null;
    this.busy = true;
    this.loading = key;
    this.place.setAttribute("aria-busy", "true");
    try {
      this.image.src = await load();
      await this.image.decode();
      this.shown = key;
      this.note.hidden = true;
    } catch (error) {
      this.say(error.words ?? "This picture cannot be shown.");
      [this.failed, this.again] = [key, Date.now() + 5000];
    }
    this.loading = null;
    this.place.removeAttribute("aria-busy");
    setTimeout(() => {
      this.busy = false;
      this.pump();
    }, this.rest);
  }

  say(text) {
    this.note.textContent = text;
    this.note.hidden = false;
  }

  draw(node) {
    this.overlay.replaceChildren(node ?? "");
  }
}

/** Boxes: motion solid and thick, model error thin and dashed, what the tuner took away dotted. */
export function regionsSvg(detection, { chosen = null, ghosts = [], arrows = [], labels = true, fit = "none", onChoose = null } = {}) {
  const { width, height } = detection.image;
  const unit = Math.min(width, height * 1.6) / 100;
  const svg = s("svg", { viewBox: `0 0 ${width} ${height}`, preserveAspectRatio: fit, "aria-hidden": "true" });
  for (const [x, y, du, dv] of arrows) svg.append(...arrow(x, y, du, dv, unit));
  for (const ghost of ghosts) svg.append(box(ghost, "ghost"));
  for (const roi of [...detection.rois].sort(byWeight)) {
    const kind = roi.label === "independent_motion" ? "motion" : "band";
    const group = s("g", { class: `roi ${kind}${roi.id === chosen ? " chosen" : ""}` }, box(roi, "halo"), box(roi, "line"));
    if (labels && kind === "motion") group.append(tag(roi, unit, width));
    if (onChoose) {
      const hit = box(roi, "hit");
      hit.addEventListener("click", () => onChoose(roi.id));
      group.append(hit);
    }
    svg.append(group);
  }
  return svg;
}

function box(roi, kind) {
  const { x, y, width, height } = roi.bbox;
  return s("rect", { x, y, width, height, class: kind, "vector-effect": "non-scaling-stroke" });
}

function tag(roi, unit, imageWidth) {
  const text = `${roi.track_id === null ? "" : `#${roi.track_id} `}${roi.score.toFixed(2)}`;
  const size = unit * 3.6;
  const wide = text.length * size * 0.62 + size * 0.5;
  const x = Math.max(0, Math.min(roi.bbox.x, imageWidth - wide));
  const above = roi.bbox.y > size * 1.4;
  const y = above ? roi.bbox.y - size * 1.35 : roi.bbox.y + roi.bbox.height + size * 0.1;
  return s("g", { class: "tag" },
    s("rect", { x, y, width: wide, height: size * 1.3, rx: size * 0.2 }),
    s("text", { x: x + size * 0.28, y: y + size * 0.98, "font-size": size }, text));
}

function arrow(x, y, du, dv, unit) {
  const length = Math.hypot(du, dv);
  if (length < 0.2) return [s("circle", { cx: x, cy: y, r: unit * 0.25, class: "flow-dot" })];
  const [tx, ty] = [x + du * 2, y + dv * 2];
  const head = unit * 1.1;
  const [ux, uy] = [du / length, dv / length];
  const points = [[tx, ty], [tx - head * ux - head * 0.5 * uy, ty - head * uy + head * 0.5 * ux],
    [tx - head * ux + head * 0.5 * uy, ty - head * uy - head * 0.5 * ux]];
  return [
    s("line", { x1: x, y1: y, x2: tx, y2: ty, class: "flow-line", "vector-effect": "non-scaling-stroke" }),
    s("polygon", { points: points.map((p) => p.join(",")).join(" "), class: "flow-head" }),
  ];
}

/** A small drawing of a label's line style, for legends and lists. */
export function labelSwatch(label) {
  const kind = label === "independent_motion" ? "motion" : "band";
  return s("svg", { viewBox: "0 0 22 14", width: 22, height: 14, class: `roi swatch ${kind}`, role: "img", "aria-label": LABELS[label] },
    s("rect", { x: 2, y: 2, width: 18, height: 10, class: "line" }));
}
