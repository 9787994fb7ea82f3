// How is a rectangle drawn on the picture and given to a token?
import { follow, note, shape } from "./elements.js";
import { FAST } from "./numbers.js";
import { HANDLES, between, isRectangle, resized, shifted, whole } from "./rectangles.js";

const HANDLE_PX = 9;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

/** Rectangles over the picture: drawn anew, moved, and resized by eight handles or by keys. */
export function roiPart(panel, stage) {
  /** @type {Map<string, any>} by hyperparameter */
  const drawn = new Map();
  let entries = [];
  let isDrawing = false;
  let dragged = "";
  const sizes = new Map();
  const watchers = [];

  const valueOf = (name) => {
    const value = panel.state.values[name];
    return isRectangle(value) ? value : whole(stage.size);
  };

  /** Whether a rectangle in the pixels of one token means the same on the one that is shown. */
  function fits(entry) {
    if (!panel.state.token || !stage.size.width || stage.canvas.hidden) return false;
    const size = sizes.get(entry.token);
    if (entry.token === panel.state.token) return true;
    if (entry.cuts_out?.includes(panel.state.token)) return false;
    return Boolean(size && size.width === stage.size.width && size.height === stage.size.height);
  }

  const change = (name, value, commit) => {
    panel.state.values[name] = value;
    paint(name);
    panel.set({ [name]: value }, commit);
  };

  function dragOf(name, moved) {
    const start = [...valueOf(name)];
    return (event) => {
      const from = stage.onPicture(stage.pointOf(event, stage.pane));
      dragged = name;
      panel.hold([name]);
      let last = start;
      return {
        move(later) {
          const to = stage.onPicture(stage.pointOf(later, stage.pane));
          last = moved(start, from, to);
          change(name, last, false);
        },
        end() {
          dragged = "";
          change(name, last, true);
          panel.release([name]);
        },
      };
    };
  }

  function onKey(event, name) {
    const value = valueOf(name);
    const [dx, dy] = ARROWS[event.key] ?? [0, 0];
    let next = null;
    if (dx || dy) {
      const step = event.altKey ? FAST : 1;
      next = event.shiftKey
        ? resized(value, "se", dx * step, dy * step, stage.size)
        : shifted(value, dx * step, dy * step, stage.size);
    } else if (event.key === "Delete" || event.key === "Backspace") next = whole(stage.size);
    if (!next) return;
    event.preventDefault();
    event.stopPropagation();
    change(name, next, event.key === "Delete" || event.key === "Backspace");
  }

  function make(name) {
    const frame = shape("rect", { class: "epypes-roi-frame", tabindex: "0", role: "group", focusable: "true" });
    const shadow = shape("rect", { class: "epypes-roi-shadow" });
    const handles = HANDLES.map((handle) => shape("rect", { class: "epypes-handle", "data-handle": handle }));
    const group = shape("g", { class: "epypes-roi-one", "data-name": name }, shadow, frame, ...handles);
    follow(frame, (event) => {
      frame.focus({ preventScroll: true });
      return dragOf(name, (start, from, to) => shifted(start, to.x - from.x, to.y - from.y, stage.size))(event);
    });
    for (const node of handles) {
      follow(node, (event) => {
        frame.focus({ preventScroll: true });
        const moved = (start, from, to) => resized(start, node.dataset.handle, to.x - from.x, to.y - from.y, stage.size);
        return dragOf(name, moved)(event);
      });
    }
    frame.addEventListener("keydown", (event) => onKey(event, name));
    frame.addEventListener("blur", () => panel.commit());
    stage.roi.append(group);
    return { group, frame, shadow, handles };
  }

  function paint(name) {
    const parts = drawn.get(name);
    const [x, y, width, height] = valueOf(name);
    const scale = stage.place.scale;
    for (const rect of [parts.frame, parts.shadow]) {
      for (const [key, value] of Object.entries({ x, y, width, height })) note(rect, key, String(value));
    }
    note(parts.frame, "aria-label", `${name}: ${width} by ${height} pixels at ${x}, ${y}. Arrows move it, with Shift they resize it, Delete takes the whole picture.`);
    // A rectangle that is all of the picture is not moved, so a drag inside it pans.
    const isWhole = width === stage.size.width && height === stage.size.height;
    parts.group.classList.toggle("epypes-roi-whole", isWhole);
    const side = HANDLE_PX / scale;
    for (const node of parts.handles) {
      const handle = node.dataset.handle;
      const along = handle.includes("w") ? 0 : handle.includes("e") ? width : width / 2;
      const down = handle.includes("n") ? 0 : handle.includes("s") ? height : height / 2;
      const at = { x: x + along - side / 2, y: y + down - side / 2, width: side, height: side };
      for (const [key, value] of Object.entries(at)) note(node, key, String(value));
    }
  }

  function show() {
    for (const entry of entries) {
      const isShown = fits(entry);
      drawn.get(entry.name).group.style.display = isShown ? "" : "none";
      if (isShown && dragged !== entry.name) paint(entry.name);
    }
  }

  function setDrawing(on) {
    const entry = entries[0];
    isDrawing = Boolean(on && entry);
    if (isDrawing && !entries.some(fits)) panel.chooseStage(entry.token);
    stage.box.classList.toggle("epypes-drawing", isDrawing);
    for (const watcher of watchers) watcher();
  }

  // Before the press that would pan the picture.
  stage.pane.addEventListener(
    "pointerdown",
    (event) => {
      const entry = entries.find(fits);
      if (!isDrawing || !entry || event.button !== 0) return;
      event.preventDefault();
      event.stopImmediatePropagation();
      const name = entry.name;
      const before = [...valueOf(name)];
      const from = stage.onPicture(stage.pointOf(event));
      let last = before;
      dragged = name;
      panel.hold([name]);
      const move = (later) => {
        last = between(from, stage.onPicture(stage.pointOf(later, stage.pane)), stage.size);
        change(name, last, false);
      };
      const stop = (value) => {
        stage.pane.removeEventListener("pointermove", move);
        stage.pane.removeEventListener("pointerup", end);
        window.removeEventListener("keydown", cancel, true);
        dragged = "";
        change(name, value, true);
        panel.release([name]);
        setDrawing(false);
        drawn.get(name).frame.focus({ preventScroll: true });
      };
      const end = () => stop(last);
      const cancel = (key) => {
        if (key.key !== "Escape") return;
        key.stopPropagation();
        stop(before);
      };
      stage.pane.setPointerCapture(event.pointerId);
      stage.pane.addEventListener("pointermove", move);
      stage.pane.addEventListener("pointerup", end);
      window.addEventListener("keydown", cancel, true);
    },
    { capture: true },
  );
  stage.watch(show);

  return {
    setup(message) {
      const next = message.rois ?? [];
      for (const [name, parts] of drawn) {
        if (next.some((entry) => entry.name === name)) continue;
        parts.group.remove();
        drawn.delete(name);
      }
      entries = next;
      for (const { name } of entries) if (!drawn.has(name)) drawn.set(name, make(name));
      show();
    },
    frame({ frame, main }) {
      if (main.full_width) sizes.set(frame.token, { width: main.full_width, height: main.full_height });
      show();
    },
    toggle: () => setDrawing(!isDrawing),
    stop: () => setDrawing(false),
    watch: (watcher) => watchers.push(watcher),
    get isDrawing() { return isDrawing; },
    get exists() { return entries.length > 0; },
    isHeld: (name) => dragged === name,
  };
}
