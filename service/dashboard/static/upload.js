// A pair to look at: two pictures, the IMU samples around them, the camera if it is known.

import { ask, inWords } from "./api.js";
import { byId, h } from "./dom.js";
import { samplePair } from "./sample.js";
import { addPair, changed, lookAt, select, state } from "./state.js";

let made = false;
const fields = {};

export function openUpload() {
  const dialog = byId("upload-dialog");
  if (!made) build(dialog);
  dialog.showModal();
}

function build(dialog) {
  made = true;
  const error = h("p", { class: "error", role: "alert", hidden: true });
  const submit = h("button", { type: "submit", class: "primary" }, "Look at it");
  const file = (name, label, accept, told, required = true) => {
    fields[name] = h("input", { type: "file", id: `upload-${name}`, accept, required, "aria-describedby": `upload-${name}-told` });
    return h("div", { class: "field" }, h("label", { for: `upload-${name}` }, label), fields[name], h("p", { class: "muted", id: `upload-${name}-told` }, told));
  };
  const form = h("form", { method: "dialog" },
    h("h2", { id: "upload-title" }, "Inspect a pair"),
    h("p", { class: "muted" }, "As for POST /detect. The pair is kept in the service's memory among the latest ones, where everybody with a key to read can see it."),
    file("source", "First frame", "image/png,image/jpeg", "PNG or JPEG"),
    file("target", "Next frame", "image/png,image/jpeg", "of the same size"),
    file("imu", "IMU samples", ".json,application/json", "JSON: source_timestamp_ns, target_timestamp_ns, timestamps_ns, gyro_rad_s, accel_m_s2"),
    file("request", "Camera and options", ".json,application/json", "JSON with camera; may be left out", false),
    error,
    h("div", { class: "row end" },
      h("button", { type: "button", onclick: () => dialog.close() }, "Cancel"),
      h("button", { type: "button", id: "try-pair", onclick: async () => send(await samplePair(), dialog, error, submit) }, "Try the sample pair"), submit));
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    const parts = Object.fromEntries(Object.entries(fields).map(([name, input]) => [name, input.files[0]]));
    send(parts, dialog, error, submit);
  });
  dialog.replaceChildren(form);
}

export async function tryPair() {
  openUpload();
  byId("try-pair").click();
}

async function send(parts, dialog, error, submit) {
  const form = new FormData();
  for (const [name, part] of Object.entries(parts)) if (part) form.append(name, part instanceof File ? part : new Blob([part], { type: "application/json" }));
  error.hidden = true;
  submit.disabled = true;
  submit.textContent = "Looking";
  try {
    const found = await (await ask("/inspect", { method: "POST", body: form })).json();
    const pair = { number: found.number, stream_id: found.stream_id, session_id: "", received_at_ns: Date.now() * 1e6, detection_id: null, rig: null, signs: found.signs, detection: found.detection };
    addPair(pair);
    select(pair.stream_id);
    state.inspection = { number: pair.number, hypotheses: found.hypotheses, flow_arrows: found.flow_arrows };
    lookAt(pair.number);
    changed("inspection");
    dialog.close();
    byId("stage").focus();
  } catch (problem) {
    error.textContent = inWords(problem);
    error.hidden = false;
  }
  submit.disabled = false;
  submit.textContent = "Look at it";
}
