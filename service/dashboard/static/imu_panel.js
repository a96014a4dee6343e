// How good the IMU is, and what the stream has learned of it: plots over the remembered pairs.

import { h, onceAFrame } from "./dom.js";
import { linePlot } from "./plots.js";
import { pairsShown, subscribe } from "./state.js";
import { isOpen } from "./tabs.js";

export function addImuPanel(panel) {
  const place = h("div", {});
  panel.append(h("h3", {}, "IMU and time offset"), place);
  let drawn = 0;
  subscribe(onceAFrame(() => {
    const pairs = pairsShown();
    if (!isOpen("imu") || !pairs.length || drawn === pairs.at(-1).number) return;
    drawn = pairs.at(-1).number;
    const session = pairs.at(-1).session_id;
    place.replaceChildren(...content(pairs.filter((pair) => pair.session_id === session)));
  }));
}

function content(pairs) {
  const last = pairs.at(-1).detection.source_timestamp_ns;
  const x = (pair) => (pair.detection.source_timestamp_ns - last) / 1e9;
  const sign = (name) => pairs.map((pair) => [x(pair), pair.signs[name]]);
  const rigs = pairs.filter((pair) => pair.rig);
  const known = pairs.at(-1).rig?.applied ?? [];
  const rig = rigs.length
    ? [
      linePlot("Time offset beside the calibration", "ms", [{ label: "", points: rigs.map((p) => [x(p), p.rig.time_offset_s * 1e3, p.rig.time_offset_sigma_s * 1e3]) }]),
      linePlot("Gyro bias", "rad/s", ["x", "y", "z"].map((label, axis) => ({ label, points: rigs.map((p) => [x(p), p.rig.gyro_bias_rad_s[axis], p.rig.gyro_bias_sigma_rad_s[axis]]) }))),
      h("p", { class: "muted" }, known.length ? `Known well enough to be applied: ${known.join(", ").replaceAll("_", " ")}.` : "Nothing of the rig is known well enough yet to be applied. The bands are one standard deviation."),
    ]
    : [h("p", { class: "quiet-note" }, "No estimate of the rig: it takes a stream whose camera comes with T_cam_imu.")];
  return [
    linePlot("Turn of the images beside the gyro's", "rad/s", [{ label: "", points: sign("turn_error_rad_s") }], { zero: true }),
    linePlot("Cells that agree with one motion", "", [{ label: "", points: sign("inlier_share") }], { zero: true }),
    linePlot("Largest gap between samples", "ms", [{ label: "", points: sign("imu_largest_gap_ms") }], { zero: true }),
    ...rig, said(pairs)];
}

function said(pairs) {
  const counts = new Map();
  for (const pair of pairs) for (const { code } of pair.detection.reasons) counts.set(code, (counts.get(code) ?? 0) + 1);
  const rate = pairs.at(-1).signs.imu_rate_hz;
  const rows = [...counts].sort((a, b) => b[1] - a[1]);
  return h("div", {}, h("h4", {}, "What was said against pairs"),
    rows.length ? h("ul", { class: "plain-list" }, ...rows.map(([code, count]) => h("li", { class: "list-row" }, h("span", { class: "grow" }, code.replaceAll("_", " ")), `${count} of ${pairs.length}`))) : h("p", { class: "quiet-note" }, "Nothing."),
    h("p", { class: "muted" }, rate ? `Samples come at ${rate} Hz.` : ""));
}
