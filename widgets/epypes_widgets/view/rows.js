// What is added to the controls of ipywidgets: number boxes, resets, marks, folding and the filter.
import { consume, element, iconButton, note, say, whenInside } from "./elements.js";
import { numberBox } from "./number_box.js";
import { inMs, modelValue, same, shortly, shownAt } from "./numbers.js";

const NUMERIC = ["slider", "range", "log"];

/** Decorates the rows of the panel that this view is in; they may come later than the view. */
export function rowsPart(panel, figure) {
  let rows = [];
  let folders = [];
  let given = "";
  let root = null;
  /** @type {Map<any, any>} by row */
  const found = new Map();
  /** @type {Map<any, any>} by folder */
  const headings = new Map();
  let last = null;
  let failed = null;
  const closing = new AbortController();
  const until = { signal: closing.signal };
  const seeker = new MutationObserver(seek);

  const stopLooking = whenInside(figure, ".epypes-panel", (outer) => {
    root = outer;
    root.addEventListener("pointerdown", onDown, { capture: true, ...until });
    root.addEventListener("keydown", onEnter, { capture: true, ...until });
    root.addEventListener("input", (event) => event.target.closest?.(".epypes-filter") && filter(), until);
    root.addEventListener("focusin", (event) => nameHandles(rowAt(event.target)), until);
    seek();
  });

  function seek() {
    if (!root) return;
    for (const row of rows) if (!found.get(row)?.tail.isConnected) decorate(row);
    for (const folder of folders) if (!headings.get(folder)?.node.isConnected) decorateHeading(folder);
    if (found.size < rows.length || headings.size < folders.length) seeker.observe(root, { childList: true, subtree: true });
    else seeker.disconnect();
  }

  function decorate(row) {
    const node = root.querySelector(`.${row.css}`);
    if (!node) return;
    found.get(row)?.tail.remove();
    const boxes = NUMERIC.includes(row.kind) ? row.names.map((_, index) => numberBox(panel, row, index)) : [];
    const sign = element("span", "epypes-fault", { role: "img" });
    const label = `Reset ${row.names.join(", ")} to ${row.default.map(shortly).join(", ")}`;
    const reset = iconButton("reset", label, () => panel.send({ kind: "reset", names: row.names }), "epypes-reset");
    const tail = element("span", "epypes-tail", { "data-lm-suppress-shortcuts": "true" });
    boxes.forEach(({ input }, index) => tail.append(...(index ? ["–"] : []), input));
    // Without a unit, too: the boxes stand below each other.
    if (boxes.length || row.unit) tail.append(element("span", "epypes-unit", {}, row.unit));
    if (row.kind === "roi") tail.append(iconButton("roi", `Draw ${row.names[0]} on the picture`, () => panel.drawRoi()));
    if (row.kind !== "shown") tail.append(reset);
    tail.append(sign);
    note(node, "data-kind", row.kind);
    node.append(tail);
    found.set(row, { node, tail, boxes, reset, sign });
    nameHandles(row);
    if (boxes.length) bind(row);
    mark(row);
  }

  /** Sliders of the library have no names of their own. */
  function nameHandles(row) {
    found.get(row)?.node.querySelectorAll(".noUi-handle").forEach((handle, index) => note(handle, "aria-label", row.names[index] ?? row.names[0]));
  }

  async function bind(row) {
    const model = await panel.widgetModel(row.model);
    if (!model || closing.signal.aborted) return;
    const update = () => moved(row, model.get("value"));
    model.on("change:value", update);
    closing.signal.addEventListener("abort", () => model.off("change:value", update));
    update();
  }

  /** A slider has come to a place. */
  function moved(row, value) {
    found.get(row)?.boxes.forEach((box, index) => box.moved(shownAt(row, [value].flat()[index])));
    mark(row);
  }

  /** Show on a row whether it differs from its default, and whether a function failed by it. */
  function mark(row) {
    const parts = found.get(row);
    if (!parts) return;
    const isChanged = row.names.some((name, index) => {
      const value = parts.boxes[index] ? parts.boxes[index].value : panel.state.values[name];
      return value !== undefined && row.default[index] !== null && !same(value, row.default[index]);
    });
    parts.node.classList.toggle("epypes-changed", isChanged);
    parts.reset.disabled = !isChanged;
    const isAtFault = row.names.some((name) => failed?.names?.includes(name));
    parts.node.classList.toggle("epypes-failed", isAtFault);
    say(parts.sign, isAtFault ? "!" : "");
    if (isAtFault) note(parts.sign, "aria-label", failed.text);
    note(parts.node, "title", isAtFault ? failed.text : row.tip);
  }

  function decorateHeading(folder) {
    const node = root.querySelector(`.${folder.css}`);
    const heading = node?.querySelector(".epypes-heading");
    if (!heading?.querySelector(".epypes-name")) return;
    const sign = element("span", "epypes-fault epypes-heading-fault");
    const attributes = { role: "button", tabindex: "0", "aria-expanded": "true", "data-lm-suppress-shortcuts": "true" };
    for (const [name, value] of Object.entries(attributes)) note(heading, name, value);
    heading.append(sign);
    const fold = () => note(heading, "aria-expanded", !node.classList.toggle("epypes-folded"));
    heading.addEventListener("click", fold, until);
    heading.addEventListener("keydown", (event) => {
      if (!["Enter", " "].includes(event.key)) return;
      consume(event);
      fold();
    }, until);
    headings.set(folder, { node, heading, sign });
    describe(folder);
  }

  function describe(folder) {
    const parts = headings.get(folder);
    if (!parts) return;
    const ms = last?.times_ms?.[folder.function];
    if (ms !== undefined) say(parts.heading.querySelector(".epypes-time"), inMs(ms));
    const isAtFault = failed?.function === folder.function;
    parts.heading.classList.toggle("epypes-failed", isAtFault);
    say(parts.sign, isAtFault ? "! failed" : "");
    note(parts.heading, "title", isAtFault ? failed.text : "");
  }

  function filter() {
    const asked = root.querySelector(".epypes-filter input").value.trim().toLowerCase();
    const words = asked.split(/\s+/).filter(Boolean);
    let matches = 0;
    for (const row of rows) {
      const text = [...row.names, row.function, row.tip, row.unit].join(" ").toLowerCase();
      const isMatch = words.every((word) => text.includes(word));
      matches += Number(isMatch);
      found.get(row)?.node.classList.toggle("epypes-unmatched", !isMatch);
    }
    for (const { node } of headings.values()) {
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
    for (const { tail } of found.values()) tail.remove();
    for (const { sign } of headings.values()) sign.remove();
    found.clear();
    headings.clear();
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
      for (const row of rows) {
        found.get(row)?.boxes.forEach((box) => box.name in frame.values && box.ran(frame.values[box.name]));
        mark(row);
      }
      folders.forEach(describe);
    },
    failure(failure) {
      failed = failure;
      rows.forEach(mark);
      folders.forEach(describe);
    },
    rowOf(name) {
      const row = rows.find((one) => one.names.includes(name));
      return row ? { row, index: row.names.indexOf(name) } : null;
    },
    close() {
      closing.abort();
      stopLooking();
      seeker.disconnect();
      clear();
    },
  };
}
