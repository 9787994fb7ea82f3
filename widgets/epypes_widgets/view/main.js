// The view of a panel: its parts, and which of them gets which message.
import { barPart } from "./bar.js";
import { chipsPart } from "./chips.js";
import { comparePart } from "./compare.js";
import { announced, element, note, say } from "./elements.js";
import { footPart } from "./foot.js";
import { clear, failures, framesPart } from "./frames.js";
import { histogramPart } from "./histogram.js";
import { watchKernel } from "./kernel.js";
import { inMs } from "./numbers.js";
import { optimisePart } from "./optimise.js";
import { overlayCount } from "./overlay.js";
import { probePart } from "./probe.js";
import { picturesPart } from "./pictures.js";
import { outbox } from "./protocol.js";
import { roiPart } from "./roi.js";
import { rowsPart } from "./rows.js";
import { sizePart } from "./size.js";
import { stagePart } from "./stage.js";
import { filmsPart, historyPart, pinnedPart, videoPart } from "./strips.js";
import { tilesPart } from "./tiles.js";

/** Messages that parts handle in a method of that name. */
const PASSED_ON = ["latency", "history", "cases", "probe", "settings", "promoted", "written", "optimised", "log"];
const GIVES_VALUES = ["reset", "undo", "redo", "goto", "load", "optimise_use"];

/** The line above the picture, and the one below it for what went wrong. */
function headerPart() {
  const [token, kind, marks, count, times] = ["epypes-token", "epypes-kind", "epypes-marks", "epypes-count", "epypes-times"].map((name) => element("span", name));
  const badge = element("span", "epypes-badge", {}, "stale");
  const status = element("div", "epypes-status", { role: "status", "aria-live": "polite" });
  const root = element("figcaption", "epypes-header", {}, token, kind, badge, marks, count, times);
  let noted = "";
  let failed = "";
  let passes = false;
  let compute_ms = 0;

  const tellTimes = (screen_ms) => say(times, `compute ${inMs(compute_ms)} / to screen ${inMs(screen_ms)}`);

  function show() {
    say(status, failed || noted);
    status.classList.toggle("epypes-at-fault", Boolean(failed));
  }

  return {
    element: root,
    // A long text covers what is below rather than move it.
    status: element("div", "epypes-status-place", {}, status),
    frame({ frame, main }) {
      if (passes) noted = "";
      show();
      say(token, frame.token);
      note(token, "title", frame.token);
      say(kind, main.shape ? `${main.dtype} ${main.shape} ${main.order ?? ""}`.trim() : "");
      say(marks, overlayCount(main.overlay));
      say(count, `${frame.ran} ran, ${frame.reused} reused${frame.skipped ? `, ${frame.skipped} skipped` : ""}`);
      note(count, "title", Object.entries(frame.times_ms).map(([name, ms]) => `${name}: ${inMs(ms)}`).join("\n"));
      compute_ms = frame.compute_ms;
      tellTimes(frame.to_screen_ms);
    },
    latency: (message) => tellTimes(message.to_screen_ms),
    failure(failure) {
      failed = failure?.text ?? "";
      show();
    },
    /** Say something that is no failure of a function; it gives way to one, and to the next frame if it passes. */
    tell(text, isPassing = false) {
      noted = text;
      passes = isPassing;
      show();
    },
  };
}

/** @param {{model: any, el: HTMLElement}} context given by anywidget */
function render({ model, el }) {
  const figure = element("figure", "epypes-view epypes-empty", { "data-lm-suppress-shortcuts": "true" });
  const closing = new AbortController();
  const kernel = watchKernel(model, el, { ended, late: (text) => header.tell(text, true), signal: closing.signal });
  const out = outbox(kernel.send);
  const send = (content) => {
    if (GIVES_VALUES.includes(content.kind)) out.forget();
    kernel.send(content);
  };
  const failed = failures();
  let described = null;
  let shownFailure = null;
  let held = "";
  /** The last message of what there is. */
  let given = /** @type {any} */ (null);
  /** What the parts share. */
  const panel = {
    ...out,
    send,
    compare: /** @type {any} */ (null),
    state: { token: "", values: {} },
    tell: (text, isPassing) => header.tell(text, isPassing),
    change(name, value, commit) {
      panel.state.values[name] = value;
      out.set({ [name]: value }, commit);
    },
    /** A value is dragged on a picture: no frame moves it until it is let go. */
    grab(name) {
      held = name;
      out.hold([name]);
    },
    letGo(name) {
      held = "";
      out.release([name]);
    },
    isHeld: (name) => held === name,
    /** Write down what a frame has beside its picture once it has been painted; only the newest if several come. */
    describe(report) {
      if (!described) setTimeout(describe);
      described = report;
    },
    refresh: () => bar?.refresh(),
    dress: (...given) => pictures.dress(...given),
    rowOf: (name) => rows.rowOf(name),
    drawRoi: () => roi.toggle(),
    widgetModel: (id) => model.widget_manager?.get_model(id).catch(() => null),
    chooseStage(token) {
      chips.select(token);
      send({ kind: "stage", token });
    },
  };
  let bar = /** @type {any} */ (null);
  const header = headerPart();
  const stage = stagePart();
  const size = sizePart(figure, stage.box);
  const compare = (panel.compare = comparePart(panel, stage));
  const pictures = picturesPart(panel, stage);
  const probe = probePart(panel, stage);
  const roi = roiPart(panel, stage);
  const histogram = histogramPart(panel);
  bar = barPart(panel, { stage, compare, pictures, histogram, probe, roi });
  const chips = chipsPart(panel);
  const rows = rowsPart(panel, figure, closing.signal);
  const pinned = pinnedPart(panel);
  const films = filmsPart(panel);
  const video = videoPart(panel);
  const history = historyPart(panel);
  const optimise = optimisePart(panel);
  const foot = footPart(panel);
  const tiles = tilesPart(panel);
  const frames = framesPart(panel, stage, tiles, failed);
  const parts = [header, bar, chips, rows, pictures, roi, histogram, probe, tiles, pinned, films, video, history, optimise, foot];
  const all = (method, ...given) => parts.forEach((part) => part[method]?.(...given));
  stage.panByDrags();
  bar.listen(figure, closing.signal);
  header.element.append(size.wide);
  // Save and Promote are on the screen together with the picture.
  figure.append(
    bar.element, chips.element, header.element, pictures.element, stage.element, size.handle, tiles.element, header.status,
    video.element, foot.element, histogram.element, pinned.element, films.tally, films.element, history.element, optimise.element,
  );
  el.append(figure);

  function describe() {
    const report = described;
    described = null;
    const { frame } = report;
    panel.state.token = frame.token;
    for (const [name, value] of Object.entries(frame.values)) {
      if (name !== held && out.takes(name, value)) panel.state.values[name] = value;
    }
    figure.classList.remove("epypes-empty");
    tellFailure();
    all("frame", report);
  }

  function tellFailure() {
    if (failed.failure === shownFailure) return;
    shownFailure = failed.failure;
    figure.classList.toggle("epypes-stale", failed.failure !== null);
    all("failure", failed.failure);
  }

  function setup(message, buffers) {
    answered();
    given = { message, buffers };
    panel.state.token = message.token ?? "";
    all("setup", message, buffers);
    // What asks the kernel to compute rests with a panel that is closed; its picture can still be looked at.
    const column = figure.closest(".epypes-panel")?.querySelector(".epypes-controls");
    const asking = [column, chips.element, tiles.asking, pinned.element, films.element, video.element, history.element, optimise.element, ...foot.asking];
    for (const node of asking) if (node) node.inert = Boolean(message.closed);
  }

  /** The kernel is gone: what is there can still be looked at, and the static output if that is nothing. */
  function ended(text) {
    answered();
    figure.classList.add("epypes-ended");
    figure.classList.toggle("epypes-void", stage.picture.hidden && stage.text.hidden);
    if (given) setup({ ...given.message, token: panel.state.token, closed: true }, given.buffers);
    stage.wait("");
    header.failure(null);
    header.tell(text);
  }

  const handlers = {
    setup,
    frame: frames.take,
    reference: (message, buffers) => compare.take(message.picture, buffers[0], message.seq, message.label),
    error(message) {
      failed.fail(message);
      tellFailure();
    },
    /** What is waited for stands where the picture will be. */
    note({ text, waits }) {
      const isInPlace = waits && figure.classList.contains("epypes-empty");
      stage.wait(isInPlace ? text : "");
      header.tell(isInPlace ? "" : text);
    },
  };
  for (const kind of PASSED_ON) handlers[kind] = (...given) => all(kind, ...given);
  const onMessage = (message, buffers) => {
    kernel.answered();
    handlers[message.kind]?.(message, buffers ?? []);
  };
  model.on("msg:custom", onMessage);
  const answered = announced(send);
  return () => {
    answered();
    send({ kind: "closed" });
    closing.abort();
    model.off("msg:custom", onMessage);
    out.close();
    stage.close();
    [stage.picture, stage.under, stage.other, stage.otherUnder].forEach((img) => clear(img));
    figure.remove();
  };
}

export default { render };
