// Tabs by the ARIA pattern: arrow keys move, the chosen panel follows.

import { byId, h } from "./dom.js";
import { changed } from "./state.js";

let chosen = "regions";
export const isOpen = (name) => chosen === name;

export function addTabs(tabs) {
  const buttons = tabs.map(([name, label]) =>
    h("button", { type: "button", role: "tab", id: `tab-${name}`, "aria-controls": `panel-${name}`, onclick: () => openTab(name) }, label));
  byId("tabs").append(...buttons);
  byId("tabs").addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    const at = tabs.findIndex(([name]) => name === chosen);
    const next = step ? (at + step + tabs.length) % tabs.length : { Home: 0, End: tabs.length - 1 }[event.key];
    if (next === undefined) return;
    event.preventDefault();
    openTab(tabs[next][0]);
    buttons[next].focus();
  });
  for (const [name, , fill] of tabs) {
    const panel = h("div", { role: "tabpanel", id: `panel-${name}`, "aria-labelledby": `tab-${name}`, tabindex: 0, class: "panel" });
    byId("panels").append(panel);
    fill(panel);
  }
  openTab(chosen);
}

export function openTab(name) {
  chosen = name;
  for (const button of byId("tabs").children) {
    const mine = button.id === `tab-${name}`;
    button.setAttribute("aria-selected", String(mine));
    button.tabIndex = mine ? 0 : -1;
  }
  for (const panel of byId("panels").children) panel.hidden = panel.id !== `panel-${name}`;
  changed("tab");
}
