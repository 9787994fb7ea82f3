// Rectangles over the picture: drawn anew, moved, and resized by eight handles or by keys.
import { ARROWS, consume, follow, keep, note, shape } from "./elements.js";
import { FAST } from "./numbers.js";

const HANDLE_PX = 9;
const HANDLES = ["nw", "n", "ne", "e", "se", "s", "sw", "w"];

/** @typedef {[number, number, number, number]} Rectangle x, y, width, height in whole pixels */

/** Return all of a picture. */
export const whole = (size) => [0, 0, size.width, size.height];

/** Return the rectangle between two points, at least a pixel wide, within the picture. */
export function between(one, other, size) {
  const along = (a, b, length) => {
    const from = Math.min(Math.max(Math.floor(Math.min(a, b)), 0), length - 1);
    const to = Math.max(Math.min(Math.ceil(Math.max(a, b)), length), from + 1);
    return [from, to - from];
  };
  const [x, width] = along(one.x, other.x, size.width);
  const [y, height] = along(one.y, other.y, size.height);
  return [x, y, width, height];
}

/** Return a rectangle moved by whole pixels; it stays as large as it is, and inside. */
export function shifted([x, y, width, height], dx, dy, size) {
  const along = (at, by, length, space) => Math.max(0, Math.min(Math.round(at + by), space - length));
  return [along(x, dx, width, size.width), along(y, dy, height, size.height), width, height];
}

/** Return a rectangle with the sides that a handle stands for moved; sides that cross change places. */
export function resized([x, y, width, height], handle, dx, dy, size) {
  const by = (side, distance) => (handle.includes(side) ? distance : 0);
  const rounded = (px, py) => ({ x: Math.round(px), y: Math.round(py) });
  return between(rounded(x + by("w", dx), y + by("n", dy)), rounded(x + width + by("e", dx), y + height + by("s", dy)), size);
}

const isRectangle = (value) => Array.isArray(value) && value.length === 4 && value.every(Number.isFinite);

function place(rect, [x, y, width, height]) {
  for (const [key, value] of Object.entries({ x, y, width, height })) note(rect, key, value);
}

export function roiPart(panel, stage) {
  /** @type {Map<string, any>} by hyperparameter */
  const drawn = new Map();
  let entries = [];
  let isDrawing = false;
  const sizes = new Map();

  const valueOf = (name) => (isRectangle(panel.state.values[name]) ? panel.state.values[name] : whole(stage.size));

  /** Whether a rectangle in the pixels of one token means the same on the one that is shown. */
  function fits({ token, cuts_out }) {
    if (!panel.state.token || !stage.size.width || stage.canvas.hidden) return false;
    if (token === panel.state.token) return true;
    const size = sizes.get(token);
    return !cuts_out?.includes(panel.state.token) && size?.width === stage.size.width && size?.height === stage.size.height;
  }

  function change(name, value, commit) {
    panel.change(name, value, commit);
    drawn.get(name).paint();
  }

  /** Follow a drag on a node: `moved` returns the rectangle; Escape gives back the one before. */
  function drag(event, name, moved) {
    const start = [...valueOf(name)];
    const at = (one) => stage.onPicture(stage.pointOf(one, stage.pane));
    const [node, from] = [event.currentTarget, at(event)];
    let last = start;
    const cancel = (key) => {
      if (key.key !== "Escape") return;
      key.stopPropagation();
      last = start;
      node.releasePointerCapture(event.pointerId);
    };
    window.addEventListener("keydown", cancel, true);
    panel.grab(name);
    return {
      move(later) {
        last = moved(start, from, at(later));
        change(name, last, false);
      },
      end() {
        window.removeEventListener("keydown", cancel, true);
        change(name, last, true);
        panel.letGo(name);
        setDrawing(false);
        drawn.get(name).frame.focus({ preventScroll: true });
      },
    };
  }

  function onKey(event, name) {
    const [value, [dx, dy]] = [valueOf(name), ARROWS[event.key] ?? [0, 0]];
    const isRemoved = event.key === "Delete" || event.key === "Backspace";
    if (!dx && !dy && !isRemoved) return;
    consume(event);
    const step = event.altKey ? FAST : 1;
    const moved = event.shiftKey ? resized(value, "se", dx * step, dy * step, stage.size) : shifted(value, dx * step, dy * step, stage.size);
    change(name, isRemoved ? whole(stage.size) : moved, isRemoved);
  }

  function make(name) {
    const frame = shape("rect", { class: "epypes-roi-frame", tabindex: "0", role: "group", focusable: "true" });
    const shadow = shape("rect", { class: "epypes-roi-shadow" });
    const handles = HANDLES.map((handle) => shape("rect", { class: "epypes-handle", "data-handle": handle, style: `cursor:${handle}-resize` }));
    const node = shape("g", { class: "epypes-roi-one", "data-name": name }, shadow, frame, ...handles);
    follow(frame, (event) => drag(event, name, (start, from, to) => shifted(start, to.x - from.x, to.y - from.y, stage.size)));
    HANDLES.forEach((handle, index) => {
      follow(handles[index], (event) => drag(event, name, (start, from, to) => resized(start, handle, to.x - from.x, to.y - from.y, stage.size)));
    });
    frame.addEventListener("keydown", (event) => onKey(event, name));
    frame.addEventListener("blur", () => panel.commit());
    stage.roi.append(node);

    function paint() {
      const [x, y, width, height] = valueOf(name);
      for (const rect of [frame, shadow]) place(rect, [x, y, width, height]);
      note(frame, "aria-label", `${name}: ${width} by ${height} pixels at ${x}, ${y}. Arrows move it, with Shift they resize it, Delete takes the whole picture.`);
      // A rectangle that is all of the picture is not moved, so a drag inside it pans.
      node.classList.toggle("epypes-roi-whole", width === stage.size.width && height === stage.size.height);
      const side = HANDLE_PX / stage.place.scale;
      HANDLES.forEach((handle, index) => {
        const along = (low, high, length) => (handle.includes(low) ? 0 : handle.includes(high) ? length : length / 2);
        place(handles[index], [x + along("w", "e", width) - side / 2, y + along("n", "s", height) - side / 2, side, side]);
      });
    }
    return { node, frame, paint };
  }

  function show() {
    for (const entry of entries) {
      const isShown = fits(entry);
      drawn.get(entry.name).node.style.display = isShown ? "" : "none";
      if (isShown && !panel.isHeld(entry.name)) drawn.get(entry.name).paint();
    }
  }

  function setDrawing(on) {
    isDrawing = Boolean(on && entries.length);
    if (isDrawing && !entries.some(fits)) panel.chooseStage(entries[0].token);
    stage.box.classList.toggle("epypes-drawing", isDrawing);
    panel.refresh();
  }

  follow(stage.pane, (event) => {
    const entry = isDrawing && entries.find(fits);
    return entry && drag(event, entry.name, (_start, from, to) => between(from, to, stage.size));
  });
  stage.watch(show);

  return {
    setup(message) {
      entries = message.rois;
      keep(drawn, entries.map(({ name }) => name), make);
      show();
    },
    frame({ frame, main }) {
      if (main.full_width) sizes.set(frame.token, { width: main.full_width, height: main.full_height });
      show();
    },
    toggle: () => setDrawing(!isDrawing),
    stop: () => setDrawing(false),
    get isDrawing() { return isDrawing; },
    get exists() { return entries.length > 0; },
  };
}
