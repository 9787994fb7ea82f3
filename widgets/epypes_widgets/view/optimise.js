// A search of hyperparameters: started, followed, stopped and used.
import { answer, element, note, say, shape, textButton } from "./elements.js";
import { newestOnly } from "./protocol.js";

const CURVE = { width: 600, height: 96, side: 8, above: 10, below: 10 };
/** More look like one line. */
const MOST_DOTS = 500;
const MOST_N = 10000;
const LEAST_REACH = 20;

/** How many trials the curve has room for: as many as there are to be, if that is not far more than there are. */
export function reach(done, n) {
  let room = LEAST_REACH;
  while (room < done) room *= 2;
  return Math.max(done, Math.min(room, n));
}

/** The best so far: a step wherever it gets better. */
export function bestSoFar(values, direction, x, y) {
  const isBetter = direction === "minimize" ? (one, other) => one < other : (one, other) => one > other;
  let best = null;
  let path = "";
  values.forEach((value, index) => {
    if (value === null || (best !== null && !isBetter(value, best))) return;
    best = value;
    path += path ? `H${x(index).toFixed(1)}V${y(value).toFixed(1)}` : `M${x(index).toFixed(1)} ${y(value).toFixed(1)}`;
  });
  return path && `${path}H${x(values.length - 1).toFixed(1)}`;
}

const fourDigits = (value) => String(Number(value.toPrecision(4)));

/** The line that starts a search, what it has found as a curve, and what matters most; hidden without a metric. */
export function optimisePart(panel) {
  const isNewest = newestOnly();
  const goal = element("span", "epypes-goal");
  const count = element("input", "epypes-input epypes-trials", { type: "number", min: "1", max: String(MOST_N), step: "1", required: "", "aria-label": "Number of trials", title: "Number of trials" });
  const start = textButton("Optimise", onStart, "epypes-search-start", "Search the values of all hyperparameters within their ranges");
  const stop = textButton("Stop", onStop, "epypes-search-stop", "Stop when the case that runs has ended");
  const use = textButton("Use best", () => panel.send({ kind: "optimise_use" }), "epypes-search-use", "Set the best values; undo goes back");
  const status = element("span", "epypes-message epypes-search-message", { role: "status" });
  const setting = element("div", "epypes-search-setting");
  const curve = shape("svg", { class: "epypes-search-curve", viewBox: `0 0 ${CURVE.width} ${CURVE.height}`, preserveAspectRatio: "none", role: "img" });
  const [high, low] = [element("span"), element("span")];
  const plot = element("div", "epypes-search-plot", { hidden: "" }, element("div", "epypes-search-ends", {}, high, low), curve);
  const parts = element("div", "epypes-search-parts", { role: "group", "aria-label": "What matters most", hidden: "" });
  const line = element("div", "epypes-search-line", {}, goal, element("span", "epypes-with", {}, count, start, stop, use), status);
  const root = element("div", "epypes-search", { role: "group", "aria-label": "Optimise", hidden: "" }, line, plot, setting, parts);

  function onStart() {
    if (!count.validity.valid) {
      answer(status, `Give a number of trials from 1 to ${MOST_N}.`, false);
      return count.focus();
    }
    start.disabled = true;
    return panel.send({ kind: "optimise", n: count.valueAsNumber });
  }

  function onStop() {
    stop.disabled = true;
    panel.send({ kind: "optimise_stop" });
  }

  function show(search) {
    if (!isNewest(search.seq)) return;
    const isRunning = search.state === "running" || search.state === "stopping";
    note(root, "data-state", search.state);
    note(root, "data-trials", search.values.length);
    say(goal, `${search.direction === "minimize" ? "Minimise" : "Maximise"} ${search.metric}`);
    note(goal, "title", `The mean of ${search.metric} over all cases`);
    if (isRunning || !count.value) count.value = String(search.n);
    // The focus goes from the one that was pressed to the other.
    const isFocused = [start, stop].includes(document.activeElement);
    count.disabled = start.hidden = isRunning;
    start.disabled = false;
    stop.hidden = !isRunning;
    stop.disabled = search.state === "stopping";
    if (isFocused) (isRunning ? stop : start).focus();
    use.hidden = search.best === null;
    answer(status, search.text, search.state !== "refused");
    say(setting, search.best === null ? "" : `Best: ${search.setting}`);
    draw(search);
    parts.hidden = search.importances.length < 2;
    parts.replaceChildren(...search.importances.map(importance));
  }

  function draw({ values, best, n, direction, metric }) {
    const known = values.filter((value) => value !== null);
    plot.hidden = known.length === 0;
    if (plot.hidden) return;
    const [least, most] = [Math.min(...known), Math.max(...known)];
    const last = Math.max(reach(values.length, n) - 1, 1);
    const x = (index) => CURVE.side + ((CURVE.width - 2 * CURVE.side) * index) / last;
    const share = (value) => (most > least ? (value - least) / (most - least) : 0.5);
    const y = (value) => CURVE.height - CURVE.below - (CURVE.height - CURVE.above - CURVE.below) * share(value);
    const dot = (index) => `M${x(index).toFixed(1)} ${y(values[index]).toFixed(1)}h0`;
    say(high, fourDigits(most));
    say(low, most > least ? fourDigits(least) : "");
    note(curve, "aria-label", `${metric} of ${values.length} trials, the best so far as a line: ${fourDigits(direction === "minimize" ? least : most)} is the best`);
    const step = Math.ceil(values.length / MOST_DOTS);
    const paths = {
      "epypes-search-failed": values.map((value, index) => (value === null ? `M${x(index).toFixed(1)} ${CURVE.height - 5}v4` : "")).join(""),
      "epypes-search-dots": values.map((value, index) => (value === null || index % step ? "" : dot(index))).join(""),
      "epypes-search-best": bestSoFar(values, direction, x, y),
      "epypes-search-top": best === null ? "" : dot(best),
    };
    curve.replaceChildren(...Object.entries(paths).map(([name, d]) => shape("path", { class: name, d })));
  }

  function importance([name, part]) {
    const percent = `${Math.round(100 * part)} %`;
    const title = `${name}: ${percent} of what makes the difference`;
    return element("span", "epypes-search-part", { title }, element("code", "", {}, name), element("meter", "", { value: part, "aria-label": title }), percent);
  }

  count.addEventListener("keydown", (event) => event.key === "Enter" && !start.hidden && !start.disabled && onStart());

  return {
    element: root,
    setup({ optimise }) {
      root.hidden = !optimise;
      if (optimise) show(optimise);
    },
    optimised: show,
  };
}
