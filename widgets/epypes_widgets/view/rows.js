// What is added to the controls of the kernel's side: number boxes, resets, marks, folding and the filter?
import { numberBox } from "./boxes.js";
import { element, iconButton, note, say } from "./elements.js";
import { inMs, same, shortly } from "./numbers.js";
import { followSlides, shownAt } from "./slides.js";

const NUMERIC = ["slider", "range", "log"];
const RETRY_MS = 100;
const RETRIES = 100;

/** Return a row whose every field that is given by name is a list as long as its names. */
export function perName(row) {
  const each = (value) => (Array.isArray(value) && !(row.kind === "roi" && value.length === 4) ? value : row.names.map(() => value ?? null));
  const fields = ["low", "high", "step", "default", "value"].map((field) => [field, each(row[field])]);
  return { ...row, ...Object.fromEntries(fields) };
}

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
  const bound = new Set();
  const closing = new AbortController();
  const seeker = new MutationObserver(() => seek());

  const at = (css) => root.querySelector(`.${CSS.escape(css)}`);
  const until = { signal: closing.signal };

  function seekRoot(tries) {
    root ??= figure.closest(".epypes-panel");
    if (!root) {
      if (tries > 0 && !closing.signal.aborted) setTimeout(() => seekRoot(tries - 1), RETRY_MS);
      return;
    }
    listen();
    seek();
  }

  function listen() {
    if (root.dataset.epypesHeard) return;
    root.dataset.epypesHeard = "yes";
    root.addEventListener("pointerdown", onDown, { capture: true, ...until });
    root.addEventListener("keydown", onEnter, { capture: true, ...until });
    root.addEventListener("input", (event) => event.target.closest?.(".epypes-filter") && filter(), until);
    root.addEventListener("focusin", (event) => nameHandles(event.target.closest?.(".epypes-row")), until);
    closing.signal.addEventListener("abort", () => delete root.dataset.epypesHeard);
    seeker.observe(root, { childList: true, subtree: true });
  }

  function seek() {
    for (const row of rows) if (!found.get(row)?.tail.isConnected) decorate(row);
    for (const folder of folders) if (!headings.get(folder)?.node.isConnected) decorateHeading(folder);
    const isAll = rows.every((row) => found.has(row)) && folders.every((folder) => headings.has(folder));
    if (isAll) seeker.disconnect();
  }

  function decorate(row) {
    const node = at(row.css);
    if (!node) return;
    found.get(row)?.tail.remove();
    const boxes = NUMERIC.includes(row.kind) ? row.names.map((_, index) => numberBox(panel, row, index)) : [];
    const sign = element("span", "epypes-fault", { role: "img" });
    const reset = iconButton("reset", `Reset ${row.names.join(", ")} to ${row.default.map(shortly).join(", ")}`, () => onReset(row), "epypes-reset");
    const tail = element("span", "epypes-tail", { "data-lm-suppress-shortcuts": "true" });
    boxes.forEach((box, index) => tail.append(...(index ? ["–"] : []), box.input));
    // Without a unit, too: the boxes stand below each other.
    if (boxes.length || row.unit) tail.append(element("span", "epypes-unit", {}, row.unit ?? ""));
    if (row.kind === "roi") tail.append(iconButton("roi", `Draw ${row.names[0]} on the picture`, () => panel.drawRoi(), "epypes-draw"));
    if (row.kind !== "shown") tail.append(reset);
    tail.append(sign);
    note(node, "data-kind", row.kind);
    if (row.tip && !node.title) node.title = row.tip;
    node.append(tail);
    found.set(row, { node, tail, boxes, reset, sign, title: row.tip ?? "" });
    nameHandles(node);
    bind(row);
    markChanged(row);
    markFault(row);
  }

  function onReset(row) {
    panel.send({ kind: "reset", names: row.names });
  }

  /** Sliders of the library have no names of their own. */
  function nameHandles(node) {
    const row = rows.find((one) => node && found.get(one)?.node === node);
    if (!row) return;
    node.querySelectorAll(".noUi-handle").forEach((handle, index) => note(handle, "aria-label", row.names[index] ?? row.names[0]));
  }

  async function bind(row) {
    if (!row.model || !NUMERIC.includes(row.kind)) return;
    const model = await panel.widgetModel(row.model);
    if (!model || closing.signal.aborted) return;
    const told = () => moved(row, model.get("value"));
    if (bound.has(row)) return told();
    bound.add(row);
    model.on("change:value", told);
    closing.signal.addEventListener("abort", () => model.off("change:value", told));
    told();
  }

  /** A slider has come to a place. */
  function moved(row, value) {
    const each = Array.isArray(value) ? value : [value];
    found.get(row)?.boxes.forEach((box, index) => box.moved(shownAt(row, each[index])));
    markChanged(row);
  }

  function valueOf(row, index) {
    const box = found.get(row)?.boxes[index];
    return box ? box.value : panel.state.values[row.names[index]];
  }

  function markChanged(row) {
    const parts = found.get(row);
    if (!parts) return;
    const isChanged = row.names.some((_, index) => {
      const value = valueOf(row, index);
      const first = row.default[index];
      return value !== undefined && first !== null && !same(value, first);
    });
    parts.node.classList.toggle("epypes-changed", isChanged);
    parts.reset.disabled = !isChanged;
  }

  function markFault(row) {
    const parts = found.get(row);
    if (!parts) return;
    const isAtFault = Boolean(failed && row.names.some((name) => failed.names?.includes(name)));
    parts.node.classList.toggle("epypes-failed", isAtFault);
    say(parts.sign, isAtFault ? "!" : "");
    if (isAtFault) note(parts.sign, "aria-label", failed.text);
    const title = isAtFault ? failed.text : parts.title;
    if (parts.node.title !== title) parts.node.title = title;
  }

  function decorateHeading(folder) {
    const node = at(folder.css);
    const heading = node?.querySelector(".epypes-heading");
    if (!heading?.querySelector(".epypes-name")) return;
    const sign = element("span", "epypes-fault epypes-heading-fault");
    note(heading, "role", "button");
    note(heading, "tabindex", "0");
    note(heading, "aria-expanded", "true");
    note(heading, "data-lm-suppress-shortcuts", "true");
    heading.append(sign);
    const fold = () => {
      const isFolded = node.classList.toggle("epypes-folded");
      note(heading, "aria-expanded", String(!isFolded));
    };
    heading.addEventListener("click", fold, until);
    heading.addEventListener("keydown", (event) => {
      if (!["Enter", " "].includes(event.key)) return;
      event.preventDefault();
      event.stopPropagation();
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
    if (isAtFault) note(parts.heading, "title", failed.text);
    else parts.heading.removeAttribute("title");
  }

  function filter() {
    const asked = (root.querySelector(".epypes-filter input")?.value ?? "").trim().toLowerCase();
    const words = asked.split(/\s+/).filter(Boolean);
    let matches = 0;
    for (const row of rows) {
      const said = [...row.names, row.function, row.tip, row.unit].join(" ").toLowerCase();
      const isMatch = words.every((word) => said.includes(word));
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

  function onDown(event) {
    const target = event.target.closest?.(".noUi-target");
    const row = target && rowAt(target);
    if (!row || event.button !== 0) return;
    const { names } = row;
    panel.hold(names);
    const over = new AbortController();
    const slid = (value) => {
      moved(row, value);
      panel.slide(row.model, value);
    };
    followSlides(target, row, slid, over.signal);
    const release = (event) => {
      // The element that had the focus loses it at this very press, which the window hears of, too.
      if (event.type === "blur" && event.target !== window) return;
      over.abort();
      panel.release(names);
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
      const told = JSON.stringify([message.rows, message.folders]);
      if (told !== given) {
        given = told;
        clear();
        rows = message.rows.map(perName);
        folders = message.folders;
        for (const row of rows) row.names.forEach((name, index) => (panel.state.values[name] ??= row.value[index]));
      }
      if (root) seeker.observe(root, { childList: true, subtree: true });
      seekRoot(RETRIES);
    },
    frame({ frame }) {
      last = frame;
      for (const row of rows) {
        const parts = found.get(row);
        parts?.boxes.forEach((box) => box.name in frame.values && box.ran(frame.values[box.name]));
        markChanged(row);
      }
      folders.forEach(describe);
    },
    failure(failure) {
      failed = failure;
      rows.forEach(markFault);
      folders.forEach(describe);
    },
    rowOf(name) {
      for (const row of rows) {
        const index = row.names.indexOf(name);
        if (index >= 0) return { row, index };
      }
      return null;
    },
    close() {
      closing.abort();
      seeker.disconnect();
      clear();
    },
  };
}
