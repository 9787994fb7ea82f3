// What of the picture is in the box, and how is it moved about?
import { element, shape } from "./elements.js";
import { PIXELATED_SCALE, fitted, inBox, kept, onPicture, panned, pixelAt, zoomed } from "./geometry.js";

const WHEEL_STEP = 1.0015;
const BUTTON_STEP = 1.5;
const PAN_PX = 40;
/** A hand that clicks moves a little. */
const CLICK_PX = 3;

/** The box with the big picture, the one that it is compared with, and the drawings above them. */
export function stagePart(panel) {
  const picture = element("img", "epypes-picture", { alt: "", hidden: "", draggable: "false" });
  const other = element("img", "epypes-other", { alt: "", draggable: "false" });
  const overlay = shape("svg", { class: "epypes-overlay", preserveAspectRatio: "none", "aria-hidden": "true" });
  const roi = shape("svg", { class: "epypes-roi", preserveAspectRatio: "none" });
  const otherMarks = shape("svg", { class: "epypes-overlay", preserveAspectRatio: "none", "aria-hidden": "true" });
  // Above the marks of the big picture: where it is seen, these are not.
  const layer = element("div", "epypes-layer", { hidden: "" }, other, otherMarks);
  const canvas = element("div", "epypes-canvas", {}, picture, overlay, layer, roi);
  const pane = element("div", "epypes-pane", {}, canvas);
  const secondCanvas = element("div", "epypes-canvas");
  const secondPane = element("div", "epypes-pane epypes-second", { hidden: "" }, secondCanvas);
  const text = element("pre", "epypes-text", { hidden: "" });
  const box = element(
    "div",
    "epypes-box",
    { tabindex: "0", role: "group", "aria-label": "Picture. Plus and minus zoom, arrows pan, 0 fits, 1 shows pixel for pixel." },
    pane,
    secondPane,
    text,
  );
  let place = { scale: 1, x: 0, y: 0 };
  let size = { width: 0, height: 0 };
  let room = { width: 0, height: 0 };
  let isFitted = true;
  const watchers = [];

  function put() {
    for (const one of [canvas, secondCanvas]) {
      one.style.left = `${place.x}px`;
      one.style.top = `${place.y}px`;
      one.style.width = `${size.width * place.scale}px`;
      one.style.height = `${size.height * place.scale}px`;
    }
    box.classList.toggle("epypes-pixelated", place.scale >= PIXELATED_SCALE);
    box.dataset.scale = String(place.scale);
    for (const watcher of watchers) watcher();
  }

  const isKnown = () => size.width > 0 && room.width > 0;

  function fit() {
    isFitted = true;
    if (!isKnown()) return;
    place = fitted(size, room);
    put();
  }

  function zoomTo(scale, point = { x: room.width / 2, y: room.height / 2 }) {
    if (!isKnown()) return;
    isFitted = false;
    place = zoomed(place, scale, point, size, room);
    put();
  }

  function panBy(dx, dy) {
    if (!isKnown()) return;
    isFitted = false;
    place = panned(place, dx, dy, size, room);
    put();
  }

  /** Take the size of the value shown; the place stays for one of the same size. */
  function resize(width, height) {
    if (width === size.width && height === size.height) return;
    size = { width, height };
    for (const svg of [overlay, otherMarks, roi]) svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    fit();
  }

  /** The point of a pointer in whichever pane it is over. */
  function pointOf(event, over = event.currentTarget) {
    const at = (over.closest?.(".epypes-pane") ?? pane).getBoundingClientRect();
    return { x: event.clientX - at.left, y: event.clientY - at.top };
  }

  function onWheel(event) {
    const isArmed = box.contains(document.activeElement);
    if (!isKnown() || !(event.ctrlKey || isArmed) || text.hidden === false) return;
    event.preventDefault();
    event.stopPropagation();
    zoomTo(place.scale * WHEEL_STEP ** -event.deltaY, pointOf(event));
  }

  function onDown(event) {
    if (event.button !== 0) return;
    box.focus({ preventScroll: true });
    const over = event.currentTarget;
    let last = { x: event.clientX, y: event.clientY };
    let isPanning = false;
    const move = (later) => {
      const [dx, dy] = [later.clientX - last.x, later.clientY - last.y];
      if (!isPanning && Math.hypot(dx, dy) < CLICK_PX) return;
      isPanning = true;
      box.classList.add("epypes-panning");
      last = { x: later.clientX, y: later.clientY };
      panBy(dx, dy);
    };
    const end = () => {
      over.removeEventListener("pointermove", move);
      box.classList.remove("epypes-panning");
    };
    over.setPointerCapture(event.pointerId);
    over.addEventListener("pointermove", move);
    over.addEventListener("lostpointercapture", end, { once: true });
    event.preventDefault();
    event.stopPropagation();
  }

  for (const one of [pane, secondPane]) {
    one.addEventListener("wheel", onWheel, { passive: false });
    one.addEventListener("pointerdown", onDown);
    one.addEventListener("dblclick", () => (isFitted ? zoomTo(1) : fit()));
  }

  // Its size is taken from here: to ask for it while a frame is shown would make the browser lay out the page.
  const sizes = new ResizeObserver(([entry]) => {
    const { width, height } = entry.contentRect;
    if (!width || (width === room.width && height === room.height)) return;
    room = { width, height };
    if (isFitted) fit();
    else if (isKnown()) {
      place = kept(place, size, room);
      put();
    }
  });
  sizes.observe(pane);

  return {
    element: box, box, pane, secondPane, canvas, secondCanvas, picture, layer, other, otherMarks, overlay, roi, text,
    fit, resize, pointOf,
    zoomBy: (factor) => zoomTo(place.scale * factor),
    zoomIn: () => zoomTo(place.scale * BUTTON_STEP),
    zoomOut: () => zoomTo(place.scale / BUTTON_STEP),
    actualSize: () => zoomTo(1),
    pan: (right, down) => panBy(-right * PAN_PX, -down * PAN_PX),
    /** The pixel at a point of a pane; null where there is no picture. */
    pixelAt: (point) => (canvas.hidden ? null : pixelAt(place, point, size)),
    onPicture: (point) => onPicture(place, point),
    inBox: (pixel) => inBox(place, pixel),
    /** Say in the place of the first picture what is waited for. */
    wait(said) {
      if (!picture.hidden || text.dataset.seq) return;
      text.textContent = said;
      text.hidden = !said;
    },
    /** Call back whenever the picture has moved in its box. */
    watch: (watcher) => watchers.push(watcher),
    get place() { return place; },
    get size() { return size; },
    get room() { return room; },
    close: () => sizes.disconnect(),
  };
}
