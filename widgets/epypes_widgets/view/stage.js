// The box with the big picture: where the picture is in it, and which of its pixels is at a point.
import { element, follow, shape } from "./elements.js";
import { overlaySvg } from "./overlay.js";

const MAX_SCALE = 64;
/** From here on single pixels are looked at, so they are drawn as squares. */
const PIXELATED_SCALE = 3;
const MAX_FITTED_SCALE = 8;
const WHEEL_STEP = 1.0015;
const BUTTON_STEP = 1.5;
const PAN_PX = 40;
/** A pointer that clicks moves a little. */
const CLICK_PX = 3;

/** @typedef {{width: number, height: number}} Size in pixels
 *  @typedef {{scale: number, x: number, y: number}} Place box pixels per picture pixel, and the picture's corner */

/** Return the place at which all of a picture is seen, in the middle. */
export function fitted(size, room) {
  const scale = Math.min(room.width / size.width, room.height / size.height, MAX_FITTED_SCALE) || 1;
  return kept({ scale, x: 0, y: 0 }, size, room);
}

/** Return a place moved so that no room stays empty that the picture could fill. */
export function kept(place, size, room) {
  const along = (at, length, space) => (length <= space ? (space - length) / 2 : Math.min(0, Math.max(space - length, at)));
  return {
    scale: place.scale,
    x: along(place.x, size.width * place.scale, room.width),
    y: along(place.y, size.height * place.scale, room.height),
  };
}

/** Return the place at another scale; what is at a point of the box stays there. */
export function zoomed(place, scale, point, size, room) {
  const next = Math.min(MAX_SCALE, Math.max(Math.min(fitted(size, room).scale, 1), scale));
  const ratio = next / place.scale;
  return kept({ scale: next, x: point.x - (point.x - place.x) * ratio, y: point.y - (point.y - place.y) * ratio }, size, room);
}

/** Return a point of the box in pixels of the picture, with fractions. */
export function onPicture(place, point) {
  return { x: (point.x - place.x) / place.scale, y: (point.y - place.y) / place.scale };
}

/** Return the pixel under a point of the box; null beside the picture. */
export function pixelAt(place, point, size) {
  const { x, y } = onPicture(place, point);
  const inside = x >= 0 && y >= 0 && x < size.width && y < size.height;
  return inside ? { x: Math.floor(x), y: Math.floor(y) } : null;
}

/** Return the middle of a pixel, in the box. */
export function inBox(place, pixel) {
  return { x: place.x + (pixel.x + 0.5) * place.scale, y: place.y + (pixel.y + 0.5) * place.scale };
}

/** The picture, the one that it is compared with, and the drawings above them. */
export function stagePart() {
  const picture = element("img", "epypes-picture", { alt: "", decoding: "sync", hidden: "", draggable: "false" });
  const other = element("img", "epypes-other", { alt: "", decoding: "sync", draggable: "false" });
  const [under, otherUnder] = [0, 1].map(() => element("img", "epypes-under", { alt: "", decoding: "sync", draggable: "false" }));
  const [overlay, otherMarks] = [overlaySvg(), overlaySvg()];
  const roi = shape("svg", { class: "epypes-roi", preserveAspectRatio: "none" });
  // Above the marks of the big picture: where it is seen, these are not.
  const layer = element("div", "epypes-layer", { hidden: "" }, otherUnder, other, otherMarks);
  const canvas = element("div", "epypes-canvas", {}, under, picture, overlay, layer, roi);
  const pane = element("div", "epypes-pane", {}, canvas);
  const secondCanvas = element("div", "epypes-canvas");
  const secondPane = element("div", "epypes-pane epypes-second", { hidden: "" }, secondCanvas);
  const text = element("pre", "epypes-text", { hidden: "" });
  const label = "Picture. Plus and minus zoom, arrows pan, 0 fits, 1 shows pixel for pixel.";
  const box = element("div", "epypes-box", { tabindex: "0", role: "group", "aria-label": label }, pane, secondPane, text);
  let place = { scale: 1, x: 0, y: 0 };
  let size = { width: 0, height: 0 };
  let room = { width: 0, height: 0 };
  let isFitted = true;
  const watchers = [];

  /** Put the picture at a place, if both its size and that of its room are known. */
  function put(next, fits = false) {
    if (!size.width || !room.width) return;
    isFitted = fits;
    place = next();
    for (const { style } of [canvas, secondCanvas]) {
      style.left = `${place.x}px`;
      style.top = `${place.y}px`;
      style.width = `${size.width * place.scale}px`;
      style.height = `${size.height * place.scale}px`;
    }
    box.classList.toggle("epypes-pixelated", place.scale >= PIXELATED_SCALE);
    box.dataset.scale = String(place.scale);
    for (const watcher of watchers) watcher();
  }

  const fit = () => put(() => fitted(size, room), true);
  const zoomTo = (scale, point = { x: room.width / 2, y: room.height / 2 }) => put(() => zoomed(place, scale, point, size, room));
  const panBy = (dx, dy) => put(() => kept({ scale: place.scale, x: place.x + dx, y: place.y + dy }, size, room));

  /** The point of a pointer in whichever pane it is over. */
  function pointOf(event, over = event.currentTarget) {
    const at = (over.closest?.(".epypes-pane") ?? pane).getBoundingClientRect();
    return { x: event.clientX - at.left, y: event.clientY - at.top };
  }

  function onWheel(event) {
    const isArmed = event.ctrlKey || box.contains(document.activeElement);
    if (!isArmed || !size.width || !text.hidden) return;
    event.preventDefault();
    event.stopPropagation();
    zoomTo(place.scale * WHEEL_STEP ** -event.deltaY, pointOf(event));
  }

  function onDown(event) {
    box.focus({ preventScroll: true });
    let last = { x: event.clientX, y: event.clientY };
    let isPanning = false;
    return {
      move(later) {
        const [dx, dy] = [later.clientX - last.x, later.clientY - last.y];
        if (!isPanning && Math.hypot(dx, dy) < CLICK_PX) return;
        isPanning = true;
        box.classList.add("epypes-panning");
        last = { x: later.clientX, y: later.clientY };
        panBy(dx, dy);
      },
      end: () => box.classList.remove("epypes-panning"),
    };
  }

  for (const one of [pane, secondPane]) {
    one.addEventListener("wheel", onWheel, { passive: false });
    one.addEventListener("dblclick", () => (isFitted ? zoomTo(1) : fit()));
  }

  // Its size is taken from here: to ask for it while a frame is shown would make the browser lay out the page.
  const sizes = new ResizeObserver(([{ contentRect: { width, height } }]) => {
    if (!width || (width === room.width && height === room.height)) return;
    room = { width, height };
    if (isFitted) fit();
    else put(() => kept(place, size, room));
  });
  sizes.observe(pane);

  return {
    element: box, box, pane, secondPane, canvas, secondCanvas, picture, under, layer, other, otherUnder, otherMarks, overlay, roi, text, fit, pointOf,
    /** Begin to pan by drags; what is drawn by a drag on the picture comes before that. */
    panByDrags: () => [pane, secondPane].forEach((one) => follow(one, onDown)),
    /** Take the size of the value shown; the place stays for one of the same size. */
    resize(width, height) {
      if (width === size.width && height === size.height) return;
      size = { width, height };
      for (const svg of [overlay, otherMarks, roi]) svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
      fit();
    },
    zoomIn: () => zoomTo(place.scale * BUTTON_STEP),
    zoomOut: () => zoomTo(place.scale / BUTTON_STEP),
    actualSize: () => zoomTo(1),
    pan: (right, down) => panBy(-right * PAN_PX, -down * PAN_PX),
    /** The pixel at a point of a pane; null where there is no picture. */
    pixelAt: (point) => (canvas.hidden ? null : pixelAt(place, point, size)),
    onPicture: (point) => onPicture(place, point),
    inBox: (pixel) => inBox(place, pixel),
    /** Say in the place of the first picture what is waited for. */
    wait(message) {
      if (!picture.hidden || text.dataset.seq) return;
      text.textContent = message;
      text.hidden = !message;
    },
    /** Call back whenever the picture has moved in its box. */
    watch: (watcher) => watchers.push(watcher),
    get place() { return place; },
    get size() { return size; },
    get room() { return room; },
    close: () => sizes.disconnect(),
  };
}
