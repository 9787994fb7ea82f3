// Elements: made in one call, changed only where they differ, dragged, and walked along by arrow keys.

const SVG = "http://www.w3.org/2000/svg";
const FIRST_ANSWER_MS = 500;
const LAST_ANSWER_MS = 8000;

/** Where each arrow key goes: to the right, and down. */
export const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** Strokes in a square of 16 by 16. */
const ICONS = {
  undo: "M6 3 2.5 6.5 6 10M3 6.5h6.5a3.5 3.5 0 0 1 0 7H7",
  redo: "M10 3l3.5 3.5L10 10M13 6.5H6.5a3.5 3.5 0 0 0 0 7H9",
  minus: "M3 8h10",
  plus: "M3 8h10M8 3v10",
  fit: "M2.5 6V2.5H6M10 2.5h3.5V6M13.5 10v3.5H10M6 13.5H2.5V10",
  flip: "M2.5 5.5h9M9 2.5l3 3-3 3M13.5 10.5h-9M7 7.5l-3 3 3 3",
  wipe: "M2.5 3h11v10h-11zM8 1v14M4.5 8h1M10.5 8h1",
  side: "M2 3h5.2v10H2zM8.8 3H14v10H8.8z",
  histogram: "M2 13.5h12M3.5 13V9M6.5 13V4.5M9.5 13V6.5M12.5 13v-3",
  marks: "M8 5.2a2.8 2.8 0 1 0 0 5.6 2.8 2.8 0 0 0 0-5.6zM8 1.5v2M8 12.5v2M1.5 8h2M12.5 8h2",
  probe: "M8 1.5v5M8 9.5v5M1.5 8h5M9.5 8h5",
  roi: "M3 5V3h2M7 3h2M11 3h2v2M13 7v2M13 11v2h-2M9 13H7M5 13H3v-2M3 9V7",
  before: "M10.5 3.5 6 8l4.5 4.5",
  after: "M5.5 3.5 10 8l-4.5 4.5",
  pin: "M6 2.5h4l-.6 4 2.1 2.2H4.5l2.1-2.2zM8 8.7v5",
  reset: "M3.2 6.2A5.2 5.2 0 1 1 2.8 9M3 2.6v3.8h3.8",
  wide: "M1.5 8h13M4.5 5l-3 3 3 3M11.5 5l3 3-3 3",
  copy: "M5.5 5.5h8v8h-8zM10.5 5.5v-3h-8v8h3",
  log: "M3 13V3M3 13h10M5.5 10.5 8 7l2 1.6 3-5",
};

function built(made, attributes, children) {
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
  made.append(...children.filter((child) => child !== null));
  return made;
}

/** @returns {any} an element with these classes; a child may be null */
export function element(tag, name = "", attributes = {}, ...children) {
  const made = built(document.createElement(tag), attributes, children);
  if (name) made.className = name;
  return made;
}

/** @returns {any} an element of SVG */
export function shape(tag, attributes = {}, ...children) {
  return built(document.createElementNS(SVG, tag), attributes, children);
}

/** Write a text only when it changes: a screen reader would read it again, and the browser lay it out again. */
export function say(node, text) {
  if (node && node.textContent !== text) node.textContent = text;
}

/** Say what came of something that was asked for; a refusal has a sign, too. */
export function answer(node, text, isGood = true) {
  say(node, text && !isGood ? `! ${text}` : text);
  note(node, "title", text);
  node.classList.toggle("epypes-refused", !isGood);
}

/** Set an attribute only when it changes. */
export function note(node, name, value) {
  if (node && node.getAttribute(name) !== String(value)) node.setAttribute(name, String(value));
}

export function icon(name) {
  return shape("svg", { viewBox: "0 0 16 16", class: "epypes-icon", "aria-hidden": "true" }, shape("path", { d: ICONS[name] }));
}

export function button(name, attributes, press, ...children) {
  const made = element("button", name, { type: "button", ...attributes }, ...children);
  made.addEventListener("click", press);
  return made;
}

/** A button with a picture, and a name that is its tooltip. */
export const iconButton = (drawn, label, press, name = "") => button(`epypes-button ${name}`, { "aria-label": label, title: label }, press, icon(drawn));

export const textButton = (text, press, name = "", title = "") => button(`epypes-button epypes-worded ${name}`, { title }, press, text);

/** Keep one thing with a node for each key: those that are missing are made, those that are not wanted any more removed. */
export function keep(things, keys, make) {
  for (const [key, { node }] of things) {
    if (keys.includes(key)) continue;
    node.remove();
    things.delete(key);
  }
  for (const key of keys) if (!things.has(key)) things.set(key, make(key));
}

/** Make a node follow the pointer from a press to its release, wherever that happens. */
export function follow(node, begin) {
  node.addEventListener("pointerdown", (event) => {
    const drag = event.button === 0 && begin(event);
    if (!drag) return;
    event.preventDefault();
    event.stopImmediatePropagation();
    const over = new AbortController();
    node.setPointerCapture(event.pointerId);
    node.addEventListener("pointermove", drag.move, { signal: over.signal });
    node.addEventListener("lostpointercapture", () => {
      over.abort();
      drag.end?.();
    }, { once: true });
  });
}

/** Move the focus among the elements of a selector by arrow keys, Home and End. */
export function walkAlong(root, selector, arrived = (_node) => undefined) {
  root.addEventListener("keydown", (event) => {
    const all = [...root.querySelectorAll(selector)];
    const at = all.indexOf(document.activeElement);
    const next = { ArrowLeft: at - 1, ArrowRight: at + 1, Home: 0, End: all.length - 1 }[event.key];
    if (at < 0 || next === undefined) return;
    consume(event);
    const node = all[(next + all.length) % all.length];
    node.focus();
    arrived(node);
  });
}

/** Keep an event from the browser, and from JupyterLab. */
export function consume(event) {
  event.preventDefault();
  event.stopPropagation();
}

/** Show bytes in an image; nothing for no bytes. */
export function fill(img, bytes, type = "image/jpeg") {
  if (!bytes?.byteLength) return img.removeAttribute("src");
  const url = URL.createObjectURL(new Blob([bytes], { type }));
  // Also when another picture is loaded in the place of this one.
  for (const end of ["load", "error"]) img.addEventListener(end, () => URL.revokeObjectURL(url), { once: true });
  img.src = url;
  return undefined;
}

/**
 * Send "ready" until it is answered; return what ends that.
 *
 * Until JupyterLab has a thread for widgets beside that of the cells, a message waits for a cell that runs: then it is
 * sent again, and the thread that is there by then handles it.
 */
export function announced(send) {
  let knocking = 0;
  const knock = (answer_ms) => {
    send({ kind: "ready" });
    knocking = setTimeout(() => knock(Math.min(2 * answer_ms, LAST_ANSWER_MS)), answer_ms);
  };
  knock(FIRST_ANSWER_MS);
  return () => clearTimeout(knocking);
}
