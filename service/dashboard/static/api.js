// All that goes to the service: the key, errors in words, and the live stream with its reconnection.

const KEY = "viflow-key";
let asking = null;

export class Problem extends Error {
  constructor(status, code, detail) {
    super(detail);
    this.status = status;
    this.code = code;
  }
}

function headers(more) {
  const key = sessionStorage.getItem(KEY);
  return key ? { ...more, "X-API-Key": key } : { ...more };
}

async function problemOf(response) {
  let body = {};
  try {
    body = await response.json();
  } catch { /* a proxy's page, or nothing */ }
  return new Problem(response.status, body.code ?? `http_${response.status}`, body.detail ?? response.statusText);
}

/** The answer, after as many keys as it takes; anything but 2xx is a Problem. */
export async function ask(path, { method = "GET", body, type, signal } = {}) {
  for (;;) {
    let response;
    try {
      response = await fetch(path, { method, body, signal, headers: headers(type ? { "Content-Type": type } : {}), cache: "no-store" });
    } catch (error) {
      if (error.name === "AbortError") throw error;
      throw new Problem(0, "unreachable", "The service cannot be reached.");
    }
    if (response.ok) return response;
    const problem = await problemOf(response);
    if (response.status !== 401) throw problem;
    await newKey(problem);
  }
}

export const askJson = async (path, options) => (await ask(path, options)).json();
export const postJson = (path, value, signal) =>
  askJson(path, { method: "POST", body: JSON.stringify(value), type: "application/json", signal });

function newKey(problem) {
  asking ??= promptForKey(problem).finally(() => { asking = null; });
  return asking;
}

export const hasKey = () => sessionStorage.getItem(KEY) !== null;

/** Another key: everything is asked for anew with it. */
export async function changeKey() {
  await newKey(new Problem(401, "key_missing", ""));
  location.reload();
}

function promptForKey(problem) {
  const dialog = document.getElementById("key-dialog");
  const input = document.getElementById("key-input");
  const error = document.getElementById("key-error");
  error.hidden = problem.code === "key_missing";
  error.textContent = "The service does not know this key.";
  input.value = "";
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("cancel", (event) => event.preventDefault(), { once: true });
    document.getElementById("key-form").addEventListener("submit", () => {
      sessionStorage.setItem(KEY, input.value.trim());
      resolve();
    }, { once: true });
  });
}

/** What went wrong, for a person. */
export function inWords(error) {
  if (!(error instanceof Problem)) return String(error.message ?? error);
  const words = {
    unreachable: "The service cannot be reached. Is it running?",
    scope_missing: `This key may not do that: ${error.message}.`,
    rate_limited: "Too many requests for this key's limit; try again in a moment.",
    overloaded: "The service is busy; try again in a moment.",
    pair_not_found: "This pair is no longer remembered by the service.",
    model_loading: "The model is still being loaded.",
    live_off: "This service remembers no pairs (VIFLOW_LIVE_PAIRS is 0).",
    streams_need_one_process: "The live view needs a service of one process (VIFLOW_WORKERS=1).",
  };
  return words[error.code] ?? `${error.message} (${error.code})`;
}

const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/**
 * Follow all streams for ever.
 * onPair(pair), onState("live" | "reconnecting" | "off", error), refresh(): the newest number, asked at every (re)connection.
 */
export async function follow({ onPair, onState, refresh }) {
  let wait = 500;
  for (;;) {
    try {
      const after = await refresh();
      const response = await ask(`/live/pairs?after=${after}`);
      onState("live");
      wait = 500;
      await readEvents(response.body, onPair);
      onState("reconnecting");
    } catch (error) {
      const off = ["live_off", "streams_need_one_process", "scope_missing"].includes(error.code);
      onState(off ? "off" : "reconnecting", error);
      if (off) wait = 10000;
    }
    await pause(wait);
    wait = Math.min(wait * 1.6, 5000);
  }
}

async function readEvents(body, onPair) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value;
    const blocks = text.split("\n\n");
    text = blocks.pop();
    for (const block of blocks) {
      const lines = block.split("\n");
      if (!lines.includes("event: pair")) continue;
      const data = lines.find((line) => line.startsWith("data: "));
      if (data) onPair(JSON.parse(data.slice(6)));
    }
  }
}

const pictures = new Map();
const MOST_PICTURES = 90;

/** An address of the picture inside this page; the newest ones are kept. */
export async function picture(pair, name, suffix = "jpg") {
  const path = `${pairPath(pair)}/${name}.${suffix}`;
  let found = pictures.get(path);
  if (found) {
    pictures.delete(path);
  } else {
    found = URL.createObjectURL(await (await ask(path)).blob());
  }
  pictures.set(path, found);
  while (pictures.size > MOST_PICTURES) {
    const [oldest, url] = pictures.entries().next().value;
    pictures.delete(oldest);
    URL.revokeObjectURL(url);
  }
  return found;
}

export const pairPath = (pair) => `/streams/${encodeURIComponent(pair.stream_id)}/pairs/${pair.number}`;
