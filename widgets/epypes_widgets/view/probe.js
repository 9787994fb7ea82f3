// Which values has the pixel under the pointer, in every stage?
import { element, say } from "./elements.js";
import { beside } from "./geometry.js";
import { FAST } from "./numbers.js";
import { oneAtATime } from "./protocol.js";

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
  const questions = oneAtATime(({ x, y }, id) => panel.send({ kind: "probe", id, x, y }));

  function hide() {
    note.hidden = true;
    pixel = null;
    questions.forget();
  }

  function move() {
    if (!point || note.hidden) return;
    const room = { width: stage.box.clientWidth, height: stage.box.clientHeight };
    const at = beside(point, { width: note.offsetWidth, height: note.offsetHeight }, room);
    note.style.transform = `translate(${at.x}px, ${at.y}px)`;
  }

  function look(next, where) {
    point = where;
    if (pixel && next.x === pixel.x && next.y === pixel.y) return move();
    pixel = next;
    questions.ask(pixel);
    move();
  }

  function onMove(event) {
    if (!isOn || isCrossed || event.buttons) return;
    const at = stage.pointOf(event);
    const next = stage.pixelAt(at);
    if (!next) return hide();
    const isSecond = event.currentTarget === stage.secondPane;
    look(next, isSecond ? { x: at.x + stage.secondPane.offsetLeft, y: at.y } : at);
  }

  function putCross() {
    cross.hidden = !isCrossed || !pixel;
    if (cross.hidden) return;
    const at = stage.inBox(pixel);
    cross.style.transform = `translate(${at.x}px, ${at.y}px)`;
    point = at;
    move();
  }

  function crossAt(next) {
    const { width, height } = stage.size;
    const inside = { x: Math.max(0, Math.min(next.x, width - 1)), y: Math.max(0, Math.min(next.y, height - 1)) };
    look(inside, stage.inBox(inside));
    putCross();
  }

  function row(parts) {
    const name = element("th", "", { scope: "row" }, parts.token);
    const said = parts.state && parts.state !== "fresh" ? `${parts.text} (${parts.state})` : parts.text;
    return element("tr", parts.token === panel.state.token ? "epypes-probe-here" : "", {}, name, element("td", "", {}, said));
  }

  for (const pane of [stage.pane, stage.secondPane]) {
    pane.addEventListener("pointermove", onMove);
    pane.addEventListener("pointerleave", () => isCrossed || hide());
    pane.addEventListener("pointerdown", () => isCrossed || hide());
  }
  stage.watch(putCross);

  return {
    message(answer) {
      if (!questions.answer(answer.id) || !pixel) return;
      if (answer.x !== pixel.x || answer.y !== pixel.y) return;
      say(heading, `x ${answer.x}  y ${answer.y}`);
      table.replaceChildren(...answer.rows.map(row));
      note.hidden = !isOn;
      move();
    },
    /** Other values are in the pixel now. */
    frame() {
      if (stage.canvas.hidden) hide();
      else if (pixel && isOn) questions.ask(pixel);
      putCross();
    },
    toggle() {
      isOn = !isOn;
      if (!isOn) stopCross();
    },
    toggleCross() {
      if (isCrossed) return stopCross();
      isOn = isCrossed = true;
      const { width, height } = stage.room;
      const middle = stage.pixelAt({ x: width / 2, y: height / 2 });
      crossAt(pixel ?? middle ?? { x: 0, y: 0 });
      return undefined;
    },
    moveCross(right, down, isFast) {
      if (!isCrossed) return false;
      const step = isFast ? FAST : 1;
      crossAt({ x: pixel.x + right * step, y: pixel.y + down * step });
      return true;
    },
    get isOn() { return isOn; },
    get isCrossed() { return isCrossed; },
  };

  function stopCross() {
    isCrossed = false;
    hide();
    putCross();
  }
}
