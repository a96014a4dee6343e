// What the page knows. Parts subscribe and draw themselves; nobody else writes.

const MOST_PAIRS = 240;
const listeners = new Set();

export const state = {
  streams: new Map(), // id -> {id, pairs (oldest first), overview}
  selected: null,
  cursor: null, // number of the pair that is looked at; null: the newest
  roi: null, // id of the region whose detail is open
  mapKind: "residual",
  showRois: true,
  showArrows: false,
  detector: null,
  models: [],
  inspection: null, // {number, hypotheses, flow_arrows} of the pair that is looked at
  tuned: null, // {number, detection} of the pair that is looked at under the tuner's options
  connection: "connecting",
};

export function changed(what) {
  for (const listener of listeners) listener(what);
}
export const subscribe = (listener) => listeners.add(listener);

export function streamOf(id) {
  let stream = state.streams.get(id);
  if (!stream) {
    stream = { id, pairs: [], overview: null, rate: 0 };
    state.streams.set(id, stream);
    state.selected ??= id;
  }
  return stream;
}

export function addPair(pair) {
  const { pairs } = streamOf(pair.stream_id);
  if (pairs.length && pairs[pairs.length - 1].number >= pair.number) return;
  pairs.push(pair);
  if (pairs.length > MOST_PAIRS) pairs.shift();
  changed("pairs");
}

/** After a (re)connection: what the service no longer remembers is gone here, too. */
export function replaceStreams(listed) {
  const names = new Set(listed.map((one) => one.overview.stream_id));
  for (const id of [...state.streams.keys()]) if (!names.has(id)) state.streams.delete(id);
  for (const { overview, pairs } of listed) {
    const stream = streamOf(overview.stream_id);
    stream.overview = overview;
    if (pairs) stream.pairs = pairs.slice(-MOST_PAIRS);
  }
  if (!pairsShown().some((pair) => pair.number === state.cursor)) state.cursor = null;
  if (!state.streams.has(state.selected)) select([...state.streams.keys()][0] ?? null);
  changed("pairs");
}

export function select(id) {
  state.selected = id;
  state.cursor = null;
  state.roi = null;
  changed("selected");
}

export const pairsShown = () => state.streams.get(state.selected)?.pairs ?? [];

export function currentPair() {
  const pairs = pairsShown();
  if (state.cursor === null) return pairs[pairs.length - 1] ?? null;
  return pairs.find((pair) => pair.number === state.cursor) ?? pairs[0] ?? null;
}

export function lookAt(number) {
  state.cursor = number;
  changed("cursor");
}

/** The regions on the picture: as judged, or as the tuner has them. */
export function currentDetection() {
  const pair = currentPair();
  if (!pair) return null;
  return state.tuned?.number === pair.number ? state.tuned.detection : pair.detection;
}

export function openRoi(id) {
  const pair = currentPair();
  state.roi = id;
  if (id !== null && pair && state.cursor === null) state.cursor = pair.number; // a detail holds still
  changed("roi");
}
