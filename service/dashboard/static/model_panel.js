// Which weights answer, and their cards: a small part of Markdown, drawn with text nodes alone.

import { h } from "./dom.js";
import { state, subscribe } from "./state.js";

export function addModelPanel(panel) {
  const models = h("div", {});
  const cards = h("div", {});
  panel.append(h("h3", {}, "Loaded weights"), models, cards);
  subscribe((what) => {
    if (what !== "detector" || !state.detector) return;
    models.replaceChildren(...state.models.map(modelTable));
    cards.replaceChildren(...state.detector.cards.map((card) => h("details", {}, h("summary", {}, `Model card of ${card.name}`), h("div", { class: "card-text" }, ...markdown(card.markdown)))));
    if (!state.detector.cards.length) cards.replaceChildren(h("p", { class: "quiet-note" }, "These weights came without a card."));
  });
}

const modelTable = (model) => h("table", { class: "facts" }, h("caption", {}, model.role === "network" ? "Network" : "Evidence head"), h("tbody", {},
  ...[["Name", `${model.name} ${model.version}`], ["Computed by", `${model.runtime}, ${model.device}, ${model.precision}`], ["SHA-256", model.sha256.slice(0, 16)]]
    .map(([name, value]) => h("tr", {}, h("th", { scope: "row" }, name), h("td", {}, value)))));

function markdown(text) {
  const blocks = [];
  let lines = [];
  const flush = () => { if (lines.length) blocks.push(block(lines)); lines = []; };
  for (const line of text.split("\n")) {
    if (!line.trim()) flush();
    else if (line.startsWith("#")) { flush(); blocks.push(heading(line)); }
    else lines.push(line);
  }
  flush();
  return blocks;
}

const heading = (line) => h(line.startsWith("# ") ? "h4" : "h5", {}, ...inline(line.replace(/^#+\s*/, "")));

function block(lines) {
  if (lines[0].startsWith("|")) return table(lines);
  if (/^[-*] /.test(lines[0])) return h("ul", {}, ...lines.map((line) => h("li", {}, ...inline(line.replace(/^[-*] /, "")))));
  return h("p", {}, ...inline(lines.join(" ")));
}

function table(lines) {
  const rows = lines.filter((line) => !/^\|[\s:|-]+\|$/.test(line) || line.replace(/[|\s]/g, "") === "")
    .map((line) => line.replace(/^\||\|\s*$/g, "").split("|").map((cell) => cell.trim())).filter((cells) => cells.some(Boolean));
  return h("div", { class: "scroll", tabindex: 0, role: "group", "aria-label": "Table of the model card" }, h("table", {}, h("tbody", {}, ...rows.map((cells) => h("tr", {}, ...cells.map((cell) => h("td", {}, ...inline(cell))))))));
}

/** `code`, **strong**, and links as their text: addresses in a card lead into a source tree. */
function inline(text) {
  return text.split(/(`[^`]+`|\*\*[^*]+\*\*|\[[^\]]+\]\([^)]+\))/).map((part) => {
    if (part.startsWith("`")) return h("code", {}, part.slice(1, -1));
    if (part.startsWith("**")) return h("strong", {}, part.slice(2, -2));
    if (part.startsWith("[")) return part.slice(1, part.indexOf("]"));
    return part;
  });
}
