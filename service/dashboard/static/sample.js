// The bundled recording, sent frame by frame as a robot would, or as one pair to look at.

import { ask, inWords } from "./api.js";
import { say } from "./announce.js";
import { byId } from "./dom.js";
import { select, state } from "./state.js";

const STREAM = "sample";
const FRAME_MS = 250;
let playing = false;

async function recording() {
  const told = await (await fetch("/dashboard/sample-recording.json")).json();
  const base = Date.now() * 1e6; // later than any play before: a stream's time only goes on
  const shifted = (stamps) => stamps.map((stamp) => stamp + base);
  return { camera: told.camera, frames_ns: shifted(told.frames_ns), imu: { ...told.imu, timestamps_ns: shifted(told.imu.timestamps_ns) } };
}

const frame = async (index) => (await fetch(`/dashboard/sample-${index}.jpg`)).blob();

/** Samples with from < stamp <= to. */
function between(imu, from, to) {
  const rows = imu.timestamps_ns.map((stamp, index) => [stamp, index]).filter(([stamp]) => stamp > from && stamp <= to).map(([, index]) => index);
  return Object.fromEntries(Object.entries(imu).map(([name, values]) => [name, rows.map((row) => values[row])]));
}

export async function playSample() {
  if (playing) return;
  playing = true;
  const button = byId("play-sample");
  button.disabled = true;
  try {
    const told = await recording();
    let sent = -Infinity;
    for (const [index, stamp] of told.frames_ns.entries()) {
      button.textContent = `Playing ${index + 1} of ${told.frames_ns.length}`;
      const imu = { frame_timestamp_ns: stamp, ...between(told.imu, sent, stamp + 5e6) };
      sent = stamp + 5e6;
      const form = new FormData();
      form.append("frame", await frame(index), "frame.jpg");
      form.append("imu", JSON.stringify(imu));
      form.append("request", JSON.stringify({ camera: told.camera }));
      const turn = new Promise((resolve) => setTimeout(resolve, FRAME_MS));
      await ask(`/streams/${STREAM}/frames`, { method: "POST", body: form });
      if (index === 1 && state.selected !== STREAM && state.streams.has(STREAM)) select(STREAM);
      await turn;
    }
    say("The sample has been played.");
    button.textContent = "Play the sample";
  } catch (error) {
    button.textContent = "Play the sample";
    const banner = byId("banner");
    banner.textContent = `The sample could not be played. ${inWords(error)}`;
    banner.hidden = false;
  }
  button.disabled = false;
  playing = false;
}

/** One pair of it as the parts of POST /inspect. */
export async function samplePair() {
  const told = await recording();
  const [source, target] = [4, 5];
  return {
    source: new File([await frame(source)], "sample-4.jpg"),
    target: new File([await frame(target)], "sample-5.jpg"),
    imu: JSON.stringify({ source_timestamp_ns: told.frames_ns[source], target_timestamp_ns: told.frames_ns[target], ...told.imu }),
    request: JSON.stringify({ camera: told.camera }),
  };
}

