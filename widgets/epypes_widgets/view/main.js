// What does the view consist of, and who gets which message?
import { barPart } from "./bar.js";
import { blobs } from "./blobs.js";
import { chipsPart } from "./chips.js";
import { comparePart } from "./compare.js";
import { element } from "./elements.js";
import { footPart } from "./foot.js";
import { headerPart } from "./header.js";
import { histogramPart } from "./histogram.js";
import { handleKeys } from "./keys.js";
import { optimisePart } from "./optimise.js";
import { outbox } from "./outbox.js";
import { probePart } from "./probe.js";
import { arrivals } from "./protocol.js";
import { roiPart } from "./roi.js";
import { rowsPart } from "./rows.js";
import { screen } from "./screen.js";
import { stagePart } from "./stage.js";
import { filmsPart, historyPart, pinnedPart } from "./strips.js";

// Until JupyterLab has a thread for widgets beside that of the cells, a message waits for a cell that runs: then it is
// said again, and the thread that is there by then hears it.
const FIRST_ANSWER_MS = 500;
const LAST_ANSWER_MS = 8000;
const GIVES_VALUES = ["reset", "undo", "redo", "goto", "load", "optimise_use"];

/** @param {{model: any, el: HTMLElement}} context given by anywidget */
function render({ model, el }) {
  const figure = element("figure", "epypes-view epypes-empty", { "data-lm-suppress-shortcuts": "true" });
  const order = arrivals();
  const out = outbox((content) => model.send(content));
  const send = (content) => {
    if (GIVES_VALUES.includes(content.kind)) out.forget();
    model.send(content);
  };
  /** What the parts share. */
  const panel = {
    send,
    set: out.set,
    slide: out.slide,
    painted: out.painted,
    took: out.took,
    commit: out.commit,
    hold: out.hold,
    release: out.release,
    blobs: blobs(),
    state: { token: "", values: {} },
    tell: (text, isPassing) => header.tell(text, isPassing),
    later,
    rowOf: (name) => rows.rowOf(name),
    drawRoi: () => roi.toggle(),
    widgetModel: (id) => model.widget_manager?.get_model(id).catch(() => null),
    chooseStage(token) {
      chips.select(token);
      send({ kind: "stage", token });
    },
  };
  const header = headerPart(panel);
  const stage = stagePart(panel);
  const compare = (panel.compare = comparePart(panel, stage));
  const probe = probePart(panel, stage);
  const roi = roiPart(panel, stage);
  const histogram = histogramPart(panel);
  const bar = barPart(panel, { stage, compare, histogram, probe, roi });
  const chips = chipsPart(panel);
  const rows = rowsPart(panel, figure);
  const pinned = pinnedPart(panel);
  const films = filmsPart(panel);
  const history = historyPart(panel);
  const optimise = optimisePart(panel);
  const foot = footPart(panel);
  const shown = screen(panel, stage, order);
  const parts = [header, bar, chips, rows, roi, histogram, probe, pinned, films, history, optimise, foot];
  const all = (method, ...given) => parts.forEach((part) => part[method]?.(...given));

  figure.append(
    bar.element, chips.element, header.element, stage.element, header.status,
    histogram.element, pinned.element, films.tally, films.element, history.element, optimise.element, foot.element,
  );
  el.append(figure);

  let latest = null;
  /** Write down what a frame says once it has been acknowledged; only the newest if several come. */
  function later(report) {
    if (!latest) setTimeout(describe);
    latest = report;
  }

  function describe() {
    const report = latest;
    latest = null;
    if (!report) return;
    const { frame } = report;
    panel.state.token = frame.token;
    for (const [name, value] of Object.entries(frame.values)) {
      const isHeld = roi.isHeld(name) || histogram.isHeld(name);
      if (!isHeld && out.takes(name, value)) panel.state.values[name] = value;
    }
    figure.classList.remove("epypes-empty");
    tellFailure();
    all("frame", report);
  }

  let told = null;
  function tellFailure() {
    const failure = order.failure;
    if (failure === told) return;
    told = failure;
    figure.classList.toggle("epypes-stale", failure !== null);
    all("failure", failure);
  }

  let knocking = 0;
  function knock(answer_ms) {
    send({ kind: "ready" });
    knocking = setTimeout(() => knock(Math.min(2 * answer_ms, LAST_ANSWER_MS)), answer_ms);
  }

  function setup(message, buffers) {
    clearTimeout(knocking);
    panel.state.token = message.token ?? "";
    all("setup", message, buffers);
    close(Boolean(message.closed));
    const past = Array.isArray(message.history) ? { entries: message.history } : message.history;
    if (past?.entries) all("history", { code: message.code, undo: message.undo, redo: message.redo, ...past }, buffers.slice(message.images?.length ?? 0));
  }

  /** What asks the kernel to compute rests with a panel that is closed; its picture can still be looked at. */
  function close(isClosed) {
    figure.classList.toggle("epypes-closed", isClosed);
    const column = figure.closest(".epypes-panel")?.querySelector(".epypes-controls");
    for (const node of [column, chips.element, pinned.element, films.element, history.element, optimise.element, ...foot.asking]) if (node) node.inert = isClosed;
  }

  /** What is waited for stands where the picture will be. */
  function tellNote({ text, waits }) {
    const isInPlace = Boolean(waits) && figure.classList.contains("epypes-empty");
    stage.wait(isInPlace ? text : "");
    header.tell(isInPlace ? "" : text);
  }

  const handlers = {
    setup,
    frame: shown.take,
    reference: (message, buffers) => compare.take(message.picture, buffers[0], message.seq, message.label),
    error: (message) => order.fail(message) && tellFailure(),
    latency: header.latency,
    history: (message, buffers) => all("history", message, buffers),
    cases: films.cases,
    probe: probe.message,
    settings: foot.settings,
    promoted: foot.promoted,
    written: foot.written,
    optimised: optimise.optimised,
    note: tellNote,
    log: foot.log,
  };
  const onMessage = (message, buffers) => handlers[message.kind]?.(message, buffers ?? []);
  const stopKeys = handleKeys(figure, { stage, compare, probe, roi, bar, send });
  const stopHiding = hideStatic(el);

  model.on("msg:custom", onMessage);
  knock(FIRST_ANSWER_MS);
  return () => {
    clearTimeout(knocking);
    send({ kind: "closed" });
    model.off("msg:custom", onMessage);
    stopKeys();
    stopHiding();
    out.close();
    rows.close();
    stage.close();
    panel.blobs.closeAll();
    figure.remove();
  };
}

/** The static picture that a notebook keeps is not needed beside a living panel. */
function hideStatic(el) {
  let area = null;
  const hide = () => {
    area = el.closest(".jp-OutputArea");
    area?.classList.add("epypes-live");
  };
  hide();
  const timer = area ? 0 : setTimeout(hide);
  return () => {
    clearTimeout(timer);
    area?.classList.remove("epypes-live");
  };
}

export default { render };
