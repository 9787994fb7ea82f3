// The values of the pixel under the pointer, in every stage.
import { element, say } from "./elements.js";
import { FAST } from "./numbers.js";
import { questions } from "./protocol.js";

const GAP_PX = 14;

/** Return where a note of some size stands beside a point without leaving the room. */
export function beside(point, note, room) {
  const along = (at, length, space) => {
    const after = at + GAP_PX;
    const placed = after + length <= space ? after : at - GAP_PX - length;
    return Math.max(0, Math.min(placed, space - length));
  };
  return { x: along(point.x, note.width, room.width), y: along(point.y, note.height, room.height) };
}

/** A small table beside the pointer, or beside a crosshair that is moved by keys. */
export function probePart(panel, stage) {
  const heading = element("div", "epypes-probe-at");
  const table = element("table", "epypes-probe-rows");
  const note = element("div", "epypes-probe", { hidden: "", role: "status" }, heading, table);
  const cross = element("div", "epypes-cross", { hidden: "" });
  stage.pane.append(cross);
  stage.box.append(note);
  let pixel = null;
  let point = null;
  let isOn = true;
  let isCrossed = false;
  const asked = questions(({ x, y }, id) => (pixel ? panel.send({ kind: "probe", id, x, y }) : false));

  function hide() {
    note.hidden = true;
    pixel = null;
  }

  function move() {
    if (!point || note.hidden) return;
    const room = { width: stage.box.clientWidth, height: stage.box.clientHeight };
    const at = beside(point, { width: note.offsetWidth, height: note.offsetHeight }, room);
    note.style.transform = `translate(${at.x}px, ${at.y}px)`;
  }

  function look(next, where) {
    point = where;
    if (next.x !== pixel?.x || next.y !== pixel?.y) {
      pixel = next;
      asked.ask(pixel);
    }
    move();
  }

  function onMove(event) {
    if (!isOn || isCrossed || event.buttons) return;
    const at = stage.pointOf(event);
    const next = stage.pixelAt(at);
    if (!next) return hide();
    const left = event.currentTarget === stage.secondPane ? stage.secondPane.offsetLeft : 0;
    look(next, { x: at.x + left, y: at.y });
  }

  function putCross() {
    cross.hidden = !isCrossed || !pixel;
    if (cross.hidden) return;
    point = stage.inBox(pixel);
    cross.style.transform = `translate(${point.x}px, ${point.y}px)`;
    move();
  }

  function crossAt({ x, y }) {
    const { width, height } = stage.size;
    const inside = { x: Math.max(0, Math.min(x, width - 1)), y: Math.max(0, Math.min(y, height - 1)) };
    look(inside, stage.inBox(inside));
    putCross();
  }

  function stopCross() {
    isCrossed = false;
    hide();
    putCross();
  }

  function row({ token, text, state }) {
    const value = state && state !== "fresh" ? `${text} (${state})` : text;
    const name = element("th", "", { scope: "row" }, token);
    return element("tr", token === panel.state.token ? "epypes-probe-here" : "", {}, name, element("td", "", {}, value));
  }

  for (const pane of [stage.pane, stage.secondPane]) {
    pane.addEventListener("pointermove", onMove);
    for (const end of ["pointerleave", "pointerdown"]) pane.addEventListener(end, () => isCrossed || hide());
  }
  stage.watch(putCross);

  return {
    probe({ id, x, y, rows }) {
      if (!asked.answer(id) || x !== pixel?.x || y !== pixel?.y) return;
      say(heading, `x ${x}  y ${y}`);
      table.replaceChildren(...rows.map(row));
      note.hidden = !isOn;
      move();
    },
    /** Other values are in the pixel now. */
    frame() {
      if (stage.canvas.hidden) hide();
      else if (pixel && isOn) asked.ask(pixel);
      putCross();
    },
    toggle() {
      isOn = !isOn;
      if (!isOn) stopCross();
    },
    toggleCross() {
      if (isCrossed) return stopCross();
      isOn = isCrossed = true;
      const middle = { x: stage.room.width / 2, y: stage.room.height / 2 };
      return crossAt(pixel ?? stage.pixelAt(middle) ?? { x: 0, y: 0 });
    },
    moveCross(right, down, isFast) {
      const step = isFast ? FAST : 1;
      if (isCrossed) crossAt({ x: pixel.x + right * step, y: pixel.y + down * step });
      return isCrossed;
    },
    get isOn() { return isOn; },
    get isCrossed() { return isCrossed; },
  };
}
