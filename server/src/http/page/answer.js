// The answer to a probe: the neighbours as rows, and the search as text to copy.

import { byId, copyButton, element, setText } from "./dom.js";
import { count, counted } from "./format.js";
import { MAX_NEIGHBORS } from "./marks.js";
import { snippets } from "./snippets.js";

/** Shows an answer of `knn` or `query` to the search `search`, and the texts of it for programs that reach `server`. */
export function showAnswer(search, answer, server) {
  const [ids, distances, tags] = [answer.ids[0] ?? [], answer.distances[0] ?? [], answer.tags?.[0] ?? []];
  const rows = ids.map((id, i) => {
    const distance = Number(distances[i]);
    return element(
      "tr",
      { data: { id: String(id), distance: String(distances[i]) } },
      element("td", { text: String(id) }),
      element("td", { class: "n", text: shown(distance), title: String(distance) }),
      element("td", { class: "n", text: String(tags[i] ?? 0) }),
    );
  });
  byId("neighbors").replaceChildren(...rows);
  const revision = count(answer.revision.number);
  const drawn = ids.length > MAX_NEIGHBORS ? ` The nearest ${MAX_NEIGHBORS} are drawn.` : "";
  setText(byId("answer-about"), `${counted(ids.length, "neighbour")} at revision ${revision}, nearest first.${drawn}`);
  byId("answer").hidden = false;
  showSnippets(search, server);
}

function shown(distance) {
  if (!Number.isFinite(distance)) return "infinite";
  return distance !== 0 && Math.abs(distance) < 1e-4 ? distance.toExponential(4) : distance.toPrecision(7);
}

// The language that was last chosen stays chosen.
let chosen = "Command line";

function showSnippets(search, server) {
  const all = snippets(search, server);
  const tabs = all.map(({ name }, i) =>
    element("button", { type: "button", role: "tab", id: `tab-${i}`, "aria-controls": `snippet-${i}`, text: name, on: { click: () => choose(i) } }),
  );
  const panels = all.map(({ name, text }, i) =>
    element(
      "div",
      { class: "code", role: "tabpanel", id: `snippet-${i}`, "aria-labelledby": `tab-${i}`, data: { language: name } },
      element("pre", { tabindex: 0 }, element("code", { text })),
      copyButton(() => text, `Copy the text for ${name}`),
    ),
  );
  const list = element("div", { class: "tabs", role: "tablist", "aria-label": "Language" }, ...tabs);
  list.addEventListener("keydown", (event) => {
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!step) return;
    const next = (tabs.findIndex((tab) => tab.tabIndex === 0) + step + tabs.length) % tabs.length;
    choose(next);
    tabs[next].focus();
  });
  byId("snippets").replaceChildren(list, ...panels);
  choose(Math.max(0, all.findIndex(({ name }) => name === chosen)));

  function choose(i) {
    chosen = all[i].name;
    tabs.forEach((tab, other) => {
      tab.setAttribute("aria-selected", String(other === i));
      tab.tabIndex = other === i ? 0 : -1;
      panels[other].hidden = other !== i;
    });
  }
}
