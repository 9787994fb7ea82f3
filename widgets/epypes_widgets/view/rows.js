// What is added to the controls of ipywidgets: number boxes, resets, marks, folding and the filter.
import { consume, element, iconButton, note, say } from "./elements.js";
import { numberBox } from "./number_box.js";
import { inMs, modelValue, same, shortly, shownAt } from "./numbers.js";

const NUMERIC = ["slider", "range", "log"];

/** A name in parts, after each of which a line may break. */
const breakable = (name) => name.split(/(?<=_)/).flatMap((part) => [part, element("wbr")]);

/** Decorates the rows of the panel that this view is in until the signal; they may come later than the view. */
export function rowsPart(panel, figure, signal) {
  let rows = [];
  let folders = [];
  let given = "";
  let root = null;
  /** @type {Map<any, any>} by row and by folder: its node, what was put into it, and a function that brings it up to date */
  const found = new Map();
  let last = null;
  let failed = null;
  const seeker = new MutationObserver(seek);
  const placed = new ResizeObserver(() => {
    root = figure.closest(".epypes-panel");
    if (!root) return;
    placed.disconnect();
    root.addEventListener("pointerdown", onDown, { capture: true, signal });
    root.addEventListener("keydown", onEnter, { capture: true, signal });
    root.addEventListener("input", (event) => event.target.closest?.(".epypes-filter") && filter(), { signal });
    root.addEventListener("focusin", (event) => nameHandles(rowAt(event.target)), { signal });
    seek();
  });
  placed.observe(figure);
  signal.addEventListener("abort", () => {
    for (const observer of [placed, seeker]) observer.disconnect();
    clear();
  });

  function seek() {
    if (!root) return;
    for (const [all, decorate] of [[rows, decorateRow], [folders, decorateHeading]]) {
      for (const one of all) {
        const node = found.get(one)?.added.isConnected ? null : root.querySelector(`.${one.css}`);
        const parts = node && decorate(one, node);
        if (!parts) continue;
        found.get(one)?.added.remove();
        found.set(one, parts);
        parts.update();
        if (parts.boxes?.length) bind(one);
      }
    }
    if (found.size < rows.length + folders.length) seeker.observe(root, { childList: true, subtree: true });
    else seeker.disconnect();
  }

  function decorateRow(row, node) {
    const boxes = NUMERIC.includes(row.kind) ? row.names.map((_, index) => numberBox(panel, row, index)) : [];
    const sign = element("span", "epypes-fault", { role: "img" });
    const label = `Reset ${row.names.join(", ")} to ${row.default.map(shortly).join(", ")}`;
    const reset = iconButton("reset", label, () => panel.send({ kind: "reset", names: row.names }), "epypes-reset");
    const added = element("span", "epypes-tail", { "data-lm-suppress-shortcuts": "true" });
    for (const { input, name } of boxes) added.append(element("span", "epypes-label", {}, ...breakable(name)), input, element("span", "epypes-unit", {}, row.unit));
    if (!boxes.length) {
      node.querySelector(".widget-label:not(:empty)")?.replaceChildren(...row.names.flatMap(breakable));
      if (row.unit) added.append(element("span", "epypes-unit", {}, row.unit));
    }
    if (row.kind === "roi") added.append(iconButton("roi", `Draw ${row.names[0]} on the picture`, () => panel.drawRoi()));
    if (row.kind !== "shown") added.append(reset);
    added.append(sign);
    note(node, "data-kind", row.kind);
    node.append(added);

    /** Show whether the row differs from its default, and whether a function failed by it. */
    function update() {
      const isChanged = row.names.some((name, index) => {
        const value = boxes[index] ? boxes[index].value : panel.state.values[name];
        return value !== undefined && row.default[index] !== null && !same(value, row.default[index]);
      });
      const isAtFault = row.names.some((name) => failed?.names?.includes(name));
      node.classList.toggle("epypes-changed", isChanged);
      // What a row without boxes stands at is not known here while it fails.
      reset.disabled = !isChanged && !isAtFault;
      node.classList.toggle("epypes-failed", isAtFault);
      say(sign, isAtFault ? "!" : "");
      if (isAtFault) note(sign, "aria-label", failed.text);
      note(node, "title", isAtFault ? failed.text : [row.names.join(", "), row.tip].filter(Boolean).join("\n"));
    }
    return { node, added, boxes, update };
  }

  function decorateHeading(folder, node) {
    const heading = node.querySelector(".epypes-heading");
    if (!heading?.querySelector(".epypes-name")) return null;
    const added = element("span", "epypes-fault epypes-heading-fault");
    const attributes = { role: "button", tabindex: "0", "aria-expanded": "true", "data-lm-suppress-shortcuts": "true" };
    for (const [name, value] of Object.entries(attributes)) note(heading, name, value);
    heading.append(added);
    const fold = () => note(heading, "aria-expanded", !node.classList.toggle("epypes-folded"));
    heading.addEventListener("click", fold, { signal });
    heading.addEventListener("keydown", (event) => {
      if (!["Enter", " "].includes(event.key)) return;
      consume(event);
      fold();
    }, { signal });

    /** Show how long the functions took, and whether one of them failed. */
    function update() {
      const times = folder.functions.map((name) => last?.times_ms?.[name] ?? NaN);
      const ms = times.reduce((sum, each) => sum + each, 0);
      if (last && Number.isFinite(ms)) say(heading.querySelector(".epypes-time"), inMs(ms));
      const isAtFault = folder.functions.includes(failed?.function);
      heading.classList.toggle("epypes-failed", isAtFault);
      say(added, isAtFault ? "! failed" : "");
      note(heading, "title", isAtFault ? failed.text : folder.functions.join(", "));
    }
    return { node, added, update };
  }

  /** Sliders of the library have no names of their own. */
  function nameHandles(row) {
    found.get(row)?.node.querySelectorAll(".noUi-handle").forEach((handle, index) => note(handle, "aria-label", row.names[index] ?? row.names[0]));
  }

  async function bind(row) {
    nameHandles(row);
    const model = await panel.widgetModel(row.model);
    if (!model || signal.aborted) return;
    const update = () => moved(row, model.get("value"));
    model.on("change:value", update);
    signal.addEventListener("abort", () => model.off("change:value", update));
    update();
  }

  /** A slider has come to a place. */
  function moved(row, value) {
    found.get(row)?.boxes.forEach((box, index) => box.moved(shownAt(row, [value].flat()[index])));
    found.get(row)?.update();
  }

  function filter() {
    const asked = root.querySelector(".epypes-filter input").value.trim().toLowerCase();
    const words = asked.split(/\s+/).filter(Boolean);
    let matches = 0;
    for (const row of rows) {
      const text = [...row.names, ...row.functions, row.tip, row.unit].join(" ").toLowerCase();
      const isMatch = words.every((word) => text.includes(word));
      matches += Number(isMatch);
      found.get(row)?.node.classList.toggle("epypes-unmatched", !isMatch);
    }
    for (const { node } of folders.map((folder) => found.get(folder)).filter(Boolean)) {
      node.classList.toggle("epypes-unmatched", !node.querySelector(".epypes-row:not(.epypes-unmatched)"));
      node.classList.toggle("epypes-filtered", words.length > 0);
    }
    panel.tell(words.length && !matches ? `No hyperparameter matches "${asked}".` : "");
  }

  const rowAt = (node) => rows.find((row) => found.get(row)?.node === node?.closest?.(".epypes-row"));

  /** A slider is pressed: what it passes on the way goes with the view's own messages; it reports its last place itself. */
  function onDown(event) {
    const target = event.target.closest?.(".noUi-target");
    const row = target && rowAt(target);
    if (!row || event.button !== 0) return;
    panel.hold(row.names);
    const over = new AbortController();
    target.noUiSlider?.on("slide.epypes", (_texts, _handle, places) => {
      const value = modelValue(row, places);
      moved(row, value);
      panel.slide(row.model, value);
    });
    const release = (event) => {
      // The element that had the focus loses it at this very press, which reaches the window, too.
      if (event.type === "blur" && event.target !== window) return;
      over.abort();
      target.noUiSlider?.off("slide.epypes");
      panel.release(row.names);
    };
    for (const end of ["pointerup", "pointercancel", "blur"]) window.addEventListener(end, release, { capture: true, signal: over.signal });
  }

  function onEnter(event) {
    const row = event.key === "Enter" && event.target.closest?.(".noUi-handle") && rowAt(event.target);
    if (row) panel.release(row.names);
  }

  function clear() {
    for (const { added } of found.values()) added.remove();
    found.clear();
  }

  return {
    setup(message) {
      const next = JSON.stringify([message.rows, message.folders]);
      if (next !== given) {
        given = next;
        clear();
        ({ rows, folders } = message);
        for (const row of rows) row.names.forEach((name, index) => (panel.state.values[name] ??= row.value[index]));
      }
      seek();
    },
    frame({ frame }) {
      last = frame;
      for (const { boxes = [], update } of found.values()) {
        boxes.forEach((box) => box.name in frame.values && box.ran(frame.values[box.name]));
        update();
      }
    },
    failure(failure) {
      failed = failure;
      for (const { update } of found.values()) update();
    },
    rowOf(name) {
      const row = rows.find((one) => one.names.includes(name));
      return row ? { row, index: row.names.indexOf(name) } : null;
    },
  };
}
