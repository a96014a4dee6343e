// Start: the parts are put into their places, then the service is followed for as long as the page is open.

import { noteMotion, say } from "./announce.js";
import { askJson, changeKey, follow, hasKey, inWords } from "./api.js";
import { byId } from "./dom.js";
import { showEmpty } from "./empty.js";
import { addEventsPanel } from "./events_panel.js";
import { addBudgetPanel } from "./budget_panel.js";
import { addImuPanel } from "./imu_panel.js";
import { addModelPanel } from "./model_panel.js";
import { learnCapabilities } from "./recorded.js";
import { addRegionsPanel } from "./regions_panel.js";
import { playSample } from "./sample.js";
import { addStage } from "./stage.js";
import { addPair, changed, replaceStreams, state, subscribe } from "./state.js";
import { addCards } from "./stream_cards.js";
import { addTabs } from "./tabs.js";
import { addTimeline } from "./timeline.js";
import { addTuner } from "./tuner.js";
import { openUpload } from "./upload.js";

const LOOK_MS = 5000;

addTabs([
  ["regions", "Regions", addRegionsPanel],
  ["events", "Events", addEventsPanel],
  ["tuner", "Tuner", addTuner],
  ["imu", "IMU", addImuPanel],
  ["budget", "Alarms", addBudgetPanel],
  ["model", "Model", addModelPanel],
]);
addCards();
addStage();
addTimeline();
subscribe(showPage);
byId("open-upload").addEventListener("click", openUpload);
byId("change-key").addEventListener("click", changeKey);
byId("play-sample").addEventListener("click", () => playSample());

let everFollowed = false;

function showPage() {
  const any = [...state.streams.values()].some((stream) => stream.pairs.length);
  byId("streams").hidden = byId("work").hidden = !any;
  showEmpty(!any && everFollowed);
}

async function refresh() {
  const { newest_number: newest, streams } = await askJson("/live");
  const listed = await Promise.all(streams.map(async (overview) => {
    const known = state.streams.get(overview.stream_id);
    const held = known?.pairs.at(-1)?.number;
    if (held === overview.newest_number) return { overview, pairs: null };
    const { pairs } = await askJson(`/streams/${encodeURIComponent(overview.stream_id)}/pairs`);
    return { overview, pairs: pairs.reverse() };
  }));
  everFollowed = true;
  replaceStreams(listed);
  if (!state.detector) await learnDetector();
  return newest;
}

async function learnDetector() {
  if (!(await askJson("/version")).model) return; // still loading; asked again soon
  try {
    [state.detector, { models: state.models }] = await Promise.all([askJson("/detector"), askJson("/models")]);
  } catch (error) {
    if (error.code !== "model_loading") throw error;
    return;
  }
  byId("model-line").textContent = `${state.detector.model.name} ${state.detector.model.version.split("+")[0]}`;
  await learnCapabilities();
  changed("detector");
}

function onState(connection, error) {
  const before = state.connection;
  state.connection = connection;
  const texts = { live: "Live", reconnecting: "Reconnecting", off: "Not available", connecting: "Connecting" };
  byId("change-key").hidden = !hasKey();
  byId("connection").dataset.state = connection;
  byId("connection-text").textContent = texts[connection];
  const banner = byId("banner");
  banner.hidden = connection === "live";
  if (connection === "reconnecting") {
    banner.textContent = "The connection to the service is lost. What is shown is the last that arrived; trying again.";
    state.detector = null; // the next process may have another model
  }
  if (connection === "off") banner.textContent = inWords(error);
  if (connection === "live" && before === "reconnecting") say("The connection is back.");
  changed("connection");
}

async function lookAround() {
  if (state.connection !== "live" || document.hidden) return;
  try {
    const { streams } = await askJson("/live");
    for (const overview of streams) {
      const stream = state.streams.get(overview.stream_id);
      if (stream) stream.overview = overview;
    }
    if (!state.detector) await learnDetector();
    changed("overview");
  } catch { /* the live stream notices, and says so */ }
}

follow({
  refresh,
  onState,
  onPair(pair) {
    addPair(pair);
    noteMotion(pair);
  },
});
setInterval(lookAround, LOOK_MS);
