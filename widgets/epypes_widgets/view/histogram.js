// Histograms of the stage shown and of those that thresholds cut, with the thresholds as lines.
import { consume, element, follow, keep, note, say, shape } from "./elements.js";
import { FAST, clamped, ends, shortly, stepped, written } from "./numbers.js";

const NEAR_THE_END = 0.75;
const LINE_KEYS = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 };

/** @typedef {{low: number, high: number, bins: number, channels: {name: string, counts: number[]}[]}} Histogram */

/** Return the share of the width at which a value stands, kept within 0 and 1. */
export function shareOf(histogram, value) {
  const span = histogram.high - histogram.low;
  return span > 0 ? Math.min(1, Math.max(0, (value - histogram.low) / span)) : 0.5;
}

/** Return the value that stands at a share of the width. */
export function valueAt(histogram, share) {
  return histogram.low + Math.min(1, Math.max(0, share)) * (histogram.high - histogram.low);
}

/** Return the height of a bin, 1 for the fullest; by its logarithm, few beside many can be seen. */
export function heightOf(count, most, isLogarithmic) {
  if (count <= 0 || most <= 0) return 0;
  return isLogarithmic ? Math.log1p(count) / Math.log1p(most) : count / most;
}

/** Return the outline of a channel as an SVG path, in a square of 1 by 1. */
export function outline(counts, most, isLogarithmic) {
  const digits = (number) => Number(number.toFixed(4));
  const bins = counts.map((count, bin) => `V${digits(1 - heightOf(count, most, isLogarithmic))}H${digits((bin + 1) / counts.length)}`);
  return `M0 1${bins.join("")}V1Z`;
}

/** Return the largest count of all channels. */
export function fullest(histogram) {
  return histogram.channels.reduce((most, channel) => channel.counts.reduce((a, b) => Math.max(a, b), most), 0);
}

export function histogramPart(panel) {
  const root = element("div", "epypes-histograms", { hidden: "" });
  /** @type {Map<string, any>} by token */
  const charts = new Map();
  let cuts = [];
  let isOn = false;
  let isLogarithmic = false;
  let last = null;
  let isSetUp = false;

  function make(token) {
    const bars = shape("svg", { viewBox: "0 0 1 1", preserveAspectRatio: "none", width: "100%", height: "100%" });
    const svg = shape("svg", { class: "epypes-histogram", "data-token": token, role: "group" }, bars);
    const [low, title, high] = [element("span"), element("span"), element("span")];
    const figure = element("div", "epypes-chart", {}, svg, element("div", "epypes-axis", {}, low, title, high));
    root.append(figure);
    return { token, svg, bars, low, high, title, figure, lines: new Map(), histogram: null };
  }

  function moveTo(chart, name, moved) {
    const found = panel.rowOf(name);
    if (!found) return;
    const { row, index } = found;
    const next = moved(row, index, row.names.map((one) => panel.state.values[one]));
    panel.change(name, next, false);
    chart.lines.get(name)?.put();
  }

  function makeLine(chart, name, at) {
    const hit = shape("line", { y1: "0", y2: "100%", class: "epypes-cut-hit" });
    const line = shape("line", { y1: "0", y2: "100%", class: "epypes-cut-line" });
    const text = shape("text", { y: 13 + 14 * at, class: "epypes-cut-text" });
    const label = `${name} on the histogram of ${chart.token}`;
    const node = shape("g", { class: "epypes-cut", role: "slider", tabindex: "0", "data-name": name, "aria-label": label }, hit, line, text);
    follow(node, () => {
      const box = chart.svg.getBoundingClientRect();
      node.focus({ preventScroll: true });
      panel.grab(name);
      return {
        move({ clientX }) {
          const value = valueAt(chart.histogram, (clientX - box.left) / box.width);
          moveTo(chart, name, (row, index, values) => clamped(row, index, value, values));
        },
        end() {
          panel.change(name, panel.state.values[name], true);
          panel.letGo(name);
        },
      };
    });
    node.addEventListener("keydown", (event) => {
      if (event.key === "Enter") panel.release([name]);
      const count = LINE_KEYS[event.key] * (event.shiftKey ? FAST : 1);
      if (!count) return;
      consume(event);
      moveTo(chart, name, (row, index, values) => stepped(row, index, values[index], count, values));
    });
    node.addEventListener("blur", () => panel.commit());
    chart.svg.append(node);

    /** Stand where the value is. */
    function put() {
      const value = panel.state.values[name];
      if (typeof value !== "number") return;
      const share = shareOf(chart.histogram, value);
      const [x, isNearEnd] = [`${(share * 100).toFixed(3)}%`, share > NEAR_THE_END];
      for (const drawn of [hit, line]) for (const end of ["x1", "x2"]) note(drawn, end, x);
      note(text, "x", x);
      note(text, "dx", isNearEnd ? -5 : 5);
      note(text, "text-anchor", isNearEnd ? "end" : "start");
      say(text, `${name} ${shortly(value)}`);
      const { row, index } = panel.rowOf(name) ?? {};
      const { low, high } = row ? ends(row, index, []) : chart.histogram;
      note(node, "aria-valuenow", written(value));
      note(node, "aria-valuemin", written(Number.isFinite(low) ? low : chart.histogram.low));
      note(node, "aria-valuemax", written(Number.isFinite(high) ? high : chart.histogram.high));
    }
    return { node, put };
  }

  function paint(token, histogram) {
    if (!charts.has(token)) charts.set(token, make(token));
    const chart = charts.get(token);
    const { low, high, channels, sampled, labels } = histogram;
    chart.histogram = histogram;
    const most = fullest(histogram);
    chart.bars.replaceChildren(
      ...channels.map(({ name, counts }) => shape("path", { class: `epypes-channel epypes-channel-${name}`, d: outline(counts, most, isLogarithmic) })),
    );
    for (const [node, end] of [[chart.low, low], [chart.high, high]]) say(node, labels ? "" : shortly(Number(end.toPrecision(6))));
    const names = channels.length > 1 ? ` ${channels.map((one) => one.name).join(" ")}` : "";
    const about = labels ? `: ${labels}` : `${names}${sampled ? ", sampled" : ""}`;
    say(chart.title, `${token}${about}${isLogarithmic ? ", log counts" : ""}`);
    note(chart.svg, "aria-label", labels ? `Areas of ${token}: ${labels}` : `Histogram of ${token} from ${shortly(low)} to ${shortly(high)}`);
    putLines(chart);
  }

  function putLines(chart) {
    // A threshold of levels has no place among areas.
    const names = chart.histogram.labels ? [] : cuts.filter((cut) => cut.token === chart.token).flatMap((cut) => cut.names);
    keep(chart.lines, names, (name) => makeLine(chart, name, names.indexOf(name)));
    for (const name of names) if (!panel.isHeld(name)) chart.lines.get(name).put();
  }

  function show(frame = last) {
    last = frame;
    if (!isOn || !frame) return;
    const wanted = new Map(Object.entries(frame.histograms ?? {}));
    if (frame.histogram) wanted.set(frame.token, frame.histogram);
    for (const [token, histogram] of wanted) paint(token, histogram);
    for (const [token, { figure }] of charts) figure.hidden = !wanted.has(token);
  }

  function switchTo(on) {
    isOn = on;
    root.hidden = !on;
    panel.refresh();
  }

  return {
    element: root,
    setup(message) {
      cuts = message.cuts;
      for (const chart of charts.values()) putLines(chart);
      if (!isSetUp) switchTo(Boolean(message.histogram));
      else if (isOn && !message.histogram) panel.send({ kind: "histogram", on: true });
      isSetUp = true;
    },
    frame: ({ frame }) => show(frame),
    toggle() {
      switchTo(!isOn);
      panel.send({ kind: "histogram", on: isOn });
      show();
    },
    toggleLog() {
      isLogarithmic = !isLogarithmic;
      show();
    },
    get isOn() { return isOn; },
    get isLogarithmic() { return isLogarithmic; },
  };
}
