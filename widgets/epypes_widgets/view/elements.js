// How is an element made, and its text changed only when it differs?

const SVG_NAMESPACE = "http://www.w3.org/2000/svg";

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
  pin: "M6 2.5h4l-.6 4 2.1 2.2H4.5l2.1-2.2zM8 8.7v5",
  reset: "M3.2 6.2A5.2 5.2 0 1 1 2.8 9M3 2.6v3.8h3.8",
  copy: "M5.5 5.5h8v8h-8zM10.5 5.5v-3h-8v8h3",
  run: "M4.5 2.8v10.4L13 8z",
  log: "M3 13V3M3 13h10M5.5 10.5 8 7l2 1.6 3-5",
};

/**
 * @param {string} tag
 * @param {string} [name] its classes
 * @param {Record<string, string>} [attributes]
 * @param {...(Node | string)} children
 * @returns {any}
 */
export function element(tag, name = "", attributes = {}, ...children) {
  const made = document.createElement(tag);
  if (name) made.className = name;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

/**
 * @param {string} tag of SVG
 * @param {Record<string, string | number>} [attributes]
 * @param {...Node} children
 * @returns {any}
 */
export function shape(tag, attributes = {}, ...children) {
  const made = document.createElementNS(SVG_NAMESPACE, tag);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, String(value));
  made.append(...children);
  return made;
}

/** Write a text only when it changes: a screen reader would say it again, and the browser lay it out again. */
export function say(node, text) {
  if (node && node.textContent !== text) node.textContent = text;
}

/** Set an attribute only when it changes. */
export function note(node, name, value) {
  if (node && node.getAttribute(name) !== value) node.setAttribute(name, value);
}

/** @param {keyof typeof ICONS} name */
export function icon(name) {
  return shape("svg", { viewBox: "0 0 16 16", class: "epypes-icon", "aria-hidden": "true" }, shape("path", { d: ICONS[name] }));
}

/**
 * A button with a picture and a name that is said and shown as a tooltip.
 * @param {string} drawn the icon's name
 * @param {string} label
 * @param {(event: any) => void} press
 * @param {string} [name] classes
 */
export function iconButton(drawn, label, press, name = "") {
  const made = element("button", `epypes-button ${name}`.trim(), { type: "button", "aria-label": label, title: label }, icon(drawn));
  made.addEventListener("click", press);
  return made;
}

/** @param {string} text @param {(event: any) => void} press @param {string} [name] @param {string} [title] */
export function textButton(text, press, name = "", title = "") {
  const made = element("button", `epypes-button epypes-worded ${name}`.trim(), { type: "button" }, text);
  if (title) made.title = title;
  made.addEventListener("click", press);
  return made;
}

/** Make a node follow the pointer from a press to its release, wherever that happens. */
export function follow(node, begin) {
  node.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    const drag = begin(event);
    if (!drag) return;
    event.preventDefault();
    event.stopPropagation();
    const moved = (later) => drag.move(later);
    const ended = (later) => {
      node.removeEventListener("pointermove", moved);
      for (const end of ENDS) node.removeEventListener(end, ended);
      drag.end?.(later);
    };
    node.setPointerCapture(event.pointerId);
    node.addEventListener("pointermove", moved);
    for (const end of ENDS) node.addEventListener(end, ended);
  });
}

const ENDS = ["pointerup", "pointercancel", "lostpointercapture"];
