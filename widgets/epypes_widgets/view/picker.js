// The contact sheet of a sweep, one tile of which is chosen with the mouse or with the keyboard.
import { ARROWS, announced, button, element, note, say } from "./elements.js";

/** Straight on before aside. */
const ASIDE = 4;

function middle(node) {
  const box = node.getBoundingClientRect();
  return [box.x + box.width / 2, box.y + box.height / 2];
}

/** Return the nearest of the nodes in a direction; undefined if there is none. */
function neighbour(from, [right, down], nodes) {
  const [x, y] = middle(from);
  const distance = (node) => {
    const [there, below] = middle(node);
    const ahead = (there - x) * right + (below - y) * down;
    return ahead < 2 ? Infinity : ahead + ASIDE * (Math.abs((there - x) * down) + Math.abs((below - y) * right));
  };
  const [nearest] = nodes.map((node) => ({ node, far: distance(node) })).sort((one, other) => one.far - other.far);
  return nearest.far < Infinity ? nearest.node : undefined;
}

/** @param {{model: any, el: HTMLElement}} context given by anywidget */
function render({ model, el }) {
  const heading = element("div", "epypes-picker-heading");
  const sheet = element("div", "epypes-picker-sheet", { role: "group", "aria-label": "Settings" });
  const status = element("div", "epypes-picker-status", { role: "status" });
  const root = element("div", "epypes-picker", { "data-lm-suppress-shortcuts": "true" }, heading, sheet, status);
  el.append(root);
  let urls = [];
  let state = { chosen: null, busy: false, text: "" };

  const tiles = () => [...sheet.querySelectorAll("button")];
  const send = (content) => model.send(content);

  /** The one tile that Tab comes to. */
  function reach(reached) {
    for (const each of tiles()) each.tabIndex = each === reached ? 0 : -1;
  }

  function tile({ place, setting, failed, text, picture, label, numbers }) {
    const what = `${setting}: ${failed ? "failed, " : ""}${[text, ...numbers].filter(Boolean).join(", ")}`;
    const name = failed ? "epypes-picker-tile epypes-picker-failed" : "epypes-picker-tile";
    const words = () => element("span", "epypes-picker-text", {}, failed ? element("b", "", {}, "failed ") : null, text);
    const shown = failed || picture === null ? words() : element("img", "", { alt: "", draggable: "false", src: urls[picture] });
    const captions = [label, ...numbers].filter(Boolean).map((line) => element("span", "epypes-picker-label", {}, line));
    const made = button(name, { "data-place": place, "aria-label": what, title: what }, () => {
      reach(made);
      made.focus();
      send({ kind: "pick", place });
    }, shown, ...captions);
    return made;
  }

  /** A table of rows and columns; where the sweep has neither, tiles one after the other. */
  function block({ title, rows: cells }, { rows, columns, row_labels, column_labels }) {
    if (!rows && !columns) {
      const flow = element("div", "epypes-picker-flow", {}, ...cells.flat(2).map(tile));
      return element("div", "", {}, title ? element("div", "epypes-picker-title", {}, title) : null, flow);
    }
    const head = (text, scope, attributes = {}) => element("th", "", { scope, ...attributes }, text);
    const line = (...nodes) => element("tr", "", {}, ...nodes);
    const first = (node) => (rows ? node() : null);
    const heads = columns
      ? [line(first(() => element("td")), head(columns, "colgroup", { colspan: column_labels.length })),
        line(first(() => head(rows, "col")), ...column_labels.map((label) => head(label, "col")))]
      : [line(head(rows, "col"), element("td"))];
    const body = cells.map((row, at) => line(first(() => head(row_labels[at], "row")), ...row.map((cell) => element("td", "", {}, ...cell.map(tile)))));
    return element("table", "", {}, title ? element("caption", "", {}, title) : null, ...heads, ...body);
  }

  function showSheet(message, buffers) {
    answered();
    urls.forEach(URL.revokeObjectURL);
    const media = {};
    message.blocks.forEach(({ rows }) => rows.flat(2).forEach(({ picture, media_type }) => (media[picture] = media_type)));
    urls = buffers.map((buffer, at) => URL.createObjectURL(new Blob([buffer], { type: media[at] })));
    const more = message.left_out ? [element("div", "epypes-picker-hint", {}, `and ${message.left_out} more, for which there is no room here`)] : [];
    const focused = root.contains(document.activeElement) ? document.activeElement?.dataset?.place : undefined;
    sheet.replaceChildren(...message.blocks.map((one) => block(one, message)), ...more);
    showTokens(message);
    showState(state);
    tiles().find(({ dataset }) => dataset.place === focused)?.focus();
  }

  function showTokens({ token, tokens }) {
    const options = [...(token === null ? [["", "values"]] : []), ...tokens.map((name) => [name, name])];
    const choice = element("select", "", { "aria-label": "Token that is shown" }, ...options.map(([value, text]) => element("option", "", { value }, text)));
    choice.value = token ?? "";
    choice.addEventListener("change", () => send({ kind: "show", token: choice.value }));
    const hint = element("span", "epypes-picker-hint", {}, "Click a tile, or press Enter on it, to set the runner to it.");
    heading.replaceChildren(...(tokens.length ? [choice] : []), hint);
  }

  function showState(next) {
    state = next;
    root.classList.toggle("epypes-picker-busy", Boolean(state.busy));
    for (const each of tiles()) note(each, "aria-pressed", Number(each.dataset.place) === state.chosen);
    say(status, state.text);
    if (!sheet.querySelector("button[tabindex='0']")) reach(sheet.querySelector("button[aria-pressed='true']") ?? tiles()[0]);
  }

  root.addEventListener("keydown", (event) => {
    const from = document.activeElement;
    const all = tiles();
    if (!all.includes(from) || event.ctrlKey || event.metaKey || event.altKey) return;
    const next = { Home: all[0], End: all.at(-1) }[event.key] ?? (ARROWS[event.key] && neighbour(from, ARROWS[event.key], all));
    if (event.key in ARROWS || next) event.preventDefault();
    event.stopPropagation();
    if (!next) return;
    reach(next);
    next.focus();
  });

  const onMessage = (message, buffers) => (message.kind === "sheet" ? showSheet(message, buffers ?? []) : showState(message));
  model.on("msg:custom", onMessage);
  const answered = announced(send);
  return () => {
    answered();
    model.off("msg:custom", onMessage);
    urls.forEach(URL.revokeObjectURL);
    root.remove();
  };
}

export default { render };
