// How is a search of hyperparameters started, followed, stopped and used?
import { element, note, say, shape, textButton } from "./elements.js";
import { newestOnly } from "./protocol.js";

const CURVE = { width: 600, height: 96, side: 8, above: 10, below: 10 };
// More can't be told apart.
const MOST_DOTS = 500;
const MOST_N = 10000;
const LEAST_REACH = 20;

/** The line that starts a search, what it has found as a curve, and what matters most; hidden without a metric. */
export function optimisePart(panel) {
  const isNewest = newestOnly();
  const goal = element("span", "epypes-goal");
  const count = element("input", "epypes-input epypes-trials", { type: "number", min: "1", max: String(MOST_N), step: "1", "aria-label": "Number of trials", title: "Number of trials" });
  const start = textButton("Optimise", onStart, "epypes-search-start", "Search the values of all hyperparameters within their ranges");
  const stop = textButton("Stop", onStop, "epypes-search-stop", "Stop when the case that runs has ended");
  const use = textButton("Use best", onUse, "epypes-search-use", "Set the best values; undo goes back");
  const said = element("span", "epypes-said epypes-search-said", { role: "status" });
  const setting = element("div", "epypes-search-setting");
  const curve = shape("svg", { class: "epypes-search-curve", viewBox: `0 0 ${CURVE.width} ${CURVE.height}`, preserveAspectRatio: "none", role: "img" });
  const low = element("span", "epypes-search-end");
  const high = element("span", "epypes-search-end");
  const plot = element("div", "epypes-search-plot", { hidden: "" }, element("div", "epypes-search-ends", {}, high, low), curve);
  const parts = element("div", "epypes-search-parts", { role: "group", "aria-label": "What matters most", hidden: "" });
  const line = element("div", "epypes-search-line", {}, goal, element("span", "epypes-with", {}, count, start, stop, use), said);
  const root = element("div", "epypes-search", { role: "group", "aria-label": "Optimise", hidden: "" }, line, plot, setting, parts);

  function onStart() {
    const n = Math.round(Number(count.value));
    if (!(n >= 1 && n <= MOST_N)) {
      tellSaid(`Give a number of trials from 1 to ${MOST_N}.`, true);
      count.focus();
      return;
    }
    start.disabled = true;
    panel.send({ kind: "optimise", n });
  }

  function onStop() {
    stop.disabled = true;
    panel.send({ kind: "optimise_stop" });
  }

  function onUse() {
    panel.send({ kind: "optimise_use" });
  }

  function tellSaid(text, isRefused) {
    say(said, isRefused ? `! ${text}` : text);
    note(said, "title", text);
    said.classList.toggle("epypes-refused", isRefused);
  }

  function show(search) {
    if (!isNewest(search.seq)) return;
    const isRunning = search.state === "running" || search.state === "stopping";
    note(root, "data-state", search.state);
    note(root, "data-trials", String(search.values.length));
    say(goal, `${search.direction === "minimize" ? "Minimise" : "Maximise"} ${search.metric}`);
    note(goal, "title", `The mean of ${search.metric} over all cases`);
    if (isRunning || !count.value) count.value = String(search.n);
    // Who has pressed the one finds the focus on the other.
    const isFocused = [start, stop].includes(document.activeElement);
    count.disabled = isRunning;
    start.disabled = false;
    start.hidden = isRunning;
    stop.hidden = !isRunning;
    stop.disabled = search.state === "stopping";
    if (isFocused) (isRunning ? stop : start).focus();
    use.hidden = search.best === null;
    tellSaid(search.text, search.state === "refused");
    say(setting, search.best === null ? "" : `Best: ${search.setting}`);
    draw(search);
    drawParts(search.importances ?? []);
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
    say(high, fourDigits(most));
    say(low, most > least ? fourDigits(least) : "");
    note(curve, "aria-label", `${metric} of ${values.length} trials, the best so far as a line: ${fourDigits(direction === "minimize" ? least : most)} is the best`);
    const step = Math.ceil(values.length / MOST_DOTS);
    const dots = values.flatMap((value, index) => (value === null || index % step ? [] : [`M${x(index).toFixed(1)} ${y(value).toFixed(1)}h0`]));
    const failed = values.flatMap((value, index) => (value === null ? [`M${x(index).toFixed(1)} ${CURVE.height - 5}v4`] : []));
    curve.replaceChildren(
      shape("path", { class: "epypes-search-failed", d: failed.join("") }),
      shape("path", { class: "epypes-search-dots", d: dots.join("") }),
      shape("path", { class: "epypes-search-best", d: bestSoFar(values, direction, x, y) }),
      ...(best === null ? [] : [shape("path", { class: "epypes-search-top", d: `M${x(best).toFixed(1)} ${y(values[best]).toFixed(1)}h0` })]),
    );
  }

  function drawParts(importances) {
    parts.hidden = importances.length < 2;
    parts.replaceChildren(
      ...importances.map(([name, part]) =>
        element(
          "span",
          "epypes-search-part",
          { title: `${name}: ${Math.round(100 * part)} % of what makes the difference` },
          element("span", "epypes-search-name", {}, name),
          element("span", "epypes-search-track", {}, element("span", "epypes-search-share", { style: `width:${Math.round(100 * part)}%` })),
          `${Math.round(100 * part)} %`,
        ),
      ),
    );
  }

  count.addEventListener("keydown", (event) => event.key === "Enter" && !start.hidden && !start.disabled && onStart());

  return {
    element: root,
    setup(message) {
      root.hidden = !message.optimise;
      if (message.optimise) show(message.optimise);
    },
    optimised: (message) => show(message),
  };
}

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

function fourDigits(value) {
  return String(Number(value.toPrecision(4)));
}
