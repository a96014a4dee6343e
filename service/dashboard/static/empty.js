// Before the first frame: how to send one, and two ways to see something right away.

import { byId, copyButton, h } from "./dom.js";
import { playSample } from "./sample.js";
import { tryPair } from "./upload.js";

export function showEmpty(wanted) {
  const place = byId("empty");
  if (place.hidden === !wanted) return;
  place.hidden = !wanted;
  if (!wanted || place.childElementCount) return;
  const address = location.origin;
  const command = `curl -sS ${address}/streams/drone7/frames \\\n  -F frame=@frame0.png \\\n  -F imu='{"frame_timestamp_ns": 1000000000, "timestamps_ns": [...], "gyro_rad_s": [...]}'`;
  place.append(
    h("img", { src: "/dashboard/icon.svg", alt: "", width: 64, height: 64 }),
    h("h2", { id: "empty-title" }, "No stream yet"),
    h("p", {}, "Send frames and IMU samples as they come, and they appear here at once. Or see it work on the bundled sample: a camera flies through a room, and so does a box."),
    h("div", { class: "row" }, h("button", { type: "button", class: "primary", id: "empty-play", onclick: () => playSample() }, "Play the sample recording"), h("button", { type: "button", id: "empty-pair", onclick: () => tryPair() }, "Try the sample pair")),
    h("div", { class: "command" }, h("pre", { tabindex: 0, "aria-label": "Command that sends a first frame" }, command), copyButton(command)));
}
