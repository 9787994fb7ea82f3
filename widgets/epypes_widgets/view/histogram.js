// How are the values of a stage spread, and where do the thresholds cut them?
import { element, follow, note, say, shape } from "./elements.js";
import { fullest, outline, shareOf, valueAt } from "./bins.js";
import { FAST, clamped, ends, shortly, stepped, written } from "./numbers.js";

const NEAR_THE_END = 0.75;

/** Histograms of the stage shown and of those that thresholds cut, with the thresholds as lines. */
export function histogramPart(panel) {
  const root = element("div", "epypes-histograms", { hidden: "" });
  /** @type {Map<string, any>} by token */
  const charts = new Map();
  let cuts = [];
  let isOn = false;
  let isLogarithmic = false;
  let dragged = "";
  let last = null;
  let isSetUp = false;
  const watchers = [];

  const namesOn = (token) => cuts.filter((cut) => cut.token === token).flatMap((cut) => cut.names);

  function make(token) {
    const bars = shape("svg", { class: "epypes-bars", viewBox: "0 0 1 1", preserveAspectRatio: "none", width: "100%", height: "100%" });
    const svg = shape("svg", { class: "epypes-histogram", "data-token": token, role: "group" }, bars);
    const low = element("span", "epypes-low");
    const high = element("span", "epypes-high");
    const title = element("span", "epypes-histogram-of");
    const foot = element("div", "epypes-axis", {}, low, title, high);
    const figure = element("div", "epypes-chart", {}, svg, foot);
    root.append(figure);
    return { token, svg, bars, low, high, title, figure, lines: new Map(), histogram: null };
  }

  function moveTo(chart, name, value, commit) {
    const found = panel.rowOf(name);
    if (!found) return;
    const { row, index } = found;
    const next = clamped(row, index, value, row.names.map((one) => panel.state.values[one]));
    panel.state.values[name] = next;
    putLine(chart, name);
    panel.set({ [name]: next }, commit);
  }

  function makeLine(chart, name, at) {
    const hit = shape("line", { y1: "0", y2: "100%", class: "epypes-cut-hit" });
    const line = shape("line", { y1: "0", y2: "100%", class: "epypes-cut-line" });
    const text = shape("text", { y: 13 + 14 * at, class: "epypes-cut-text" });
    const group = shape("g", { class: "epypes-cut", role: "slider", tabindex: "0", "data-name": name, "aria-label": `${name} on the histogram of ${chart.token}` }, hit, line, text);
    follow(group, () => {
      const box = chart.svg.getBoundingClientRect();
      group.focus({ preventScroll: true });
      dragged = name;
      panel.hold([name]);
      return {
        move: (event) => moveTo(chart, name, valueAt(chart.histogram, (event.clientX - box.left) / box.width), false),
        end() {
          dragged = "";
          panel.set({ [name]: panel.state.values[name] }, true);
          panel.release([name]);
        },
      };
    });
    group.addEventListener("keydown", (event) => onKey(event, chart, name));
    group.addEventListener("blur", () => panel.commit());
    chart.svg.append(group);
    return { group, hit, line, text };
  }

  function onKey(event, chart, name) {
    const steps = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    const found = panel.rowOf(name);
    if (event.key === "Enter") panel.release([name]);
    if (!steps || !found) return;
    event.preventDefault();
    event.stopPropagation();
    const { row, index } = found;
    const values = row.names.map((one) => panel.state.values[one]);
    moveTo(chart, name, stepped(row, index, values[index], steps * (event.shiftKey ? FAST : 1), values), false);
  }

  function putLine(chart, name) {
    const parts = chart.lines.get(name);
    const value = panel.state.values[name];
    if (!parts || typeof value !== "number") return;
    const share = shareOf(chart.histogram, value);
    const x = `${(share * 100).toFixed(3)}%`;
    for (const line of [parts.hit, parts.line]) {
      note(line, "x1", x);
      note(line, "x2", x);
    }
    note(parts.text, "x", x);
    note(parts.text, "dx", share > NEAR_THE_END ? "-5" : "5");
    note(parts.text, "text-anchor", share > NEAR_THE_END ? "end" : "start");
    say(parts.text, `${name} ${shortly(value)}`);
    const { row, index } = panel.rowOf(name) ?? {};
    const range = row ? ends(row, index, []) : { low: chart.histogram.low, high: chart.histogram.high };
    note(parts.group, "aria-valuenow", written(value));
    note(parts.group, "aria-valuemin", written(Number.isFinite(range.low) ? range.low : chart.histogram.low));
    note(parts.group, "aria-valuemax", written(Number.isFinite(range.high) ? range.high : chart.histogram.high));
  }

  function paint(token, histogram) {
    if (!charts.has(token)) charts.set(token, make(token));
    const chart = charts.get(token);
    chart.histogram = histogram;
    chart.figure.hidden = false;
    const most = fullest(histogram);
    while (chart.bars.children.length > histogram.channels.length) chart.bars.lastChild.remove();
    histogram.channels.forEach((channel, i) => {
      const path = chart.bars.children[i] ?? chart.bars.appendChild(shape("path"));
      note(path, "class", `epypes-channel epypes-channel-${channel.name}`);
      note(path, "d", outline(channel.counts, most, isLogarithmic));
    });
    say(chart.low, shortly(histogram.low));
    say(chart.high, shortly(histogram.high));
    const channels = histogram.channels.length > 1 ? ` ${histogram.channels.map((one) => one.name).join(" ")}` : "";
    say(chart.title, `${token}${channels}${histogram.sampled ? ", sampled" : ""}${isLogarithmic ? ", log counts" : ""}`);
    note(chart.svg, "aria-label", `Histogram of ${token} from ${shortly(histogram.low)} to ${shortly(histogram.high)}`);
    lines(chart);
  }

  function lines(chart) {
    const names = namesOn(chart.token);
    for (const [name, parts] of chart.lines) {
      if (names.includes(name)) continue;
      parts.group.remove();
      chart.lines.delete(name);
    }
    names.forEach((name, at) => {
      if (!chart.lines.has(name)) chart.lines.set(name, makeLine(chart, name, at));
      if (dragged !== name) putLine(chart, name);
    });
  }

  function show(frame) {
    last = frame;
    if (!isOn) return;
    const wanted = new Map(Object.entries(frame.histograms ?? {}));
    if (frame.histogram) wanted.set(frame.token, frame.histogram);
    for (const [token, chart] of charts) chart.figure.hidden = !wanted.has(token);
    for (const [token, histogram] of wanted) paint(token, histogram);
  }

  function switchTo(on) {
    isOn = on;
    root.hidden = !on;
    for (const watcher of watchers) watcher();
  }

  return {
    element: root,
    setup(message) {
      cuts = message.cuts ?? [];
      for (const chart of charts.values()) lines(chart);
      if (!isSetUp) switchTo(Boolean(message.histogram));
      else if (isOn && !message.histogram) panel.send({ kind: "histogram", on: true });
      isSetUp = true;
    },
    frame: ({ frame }) => show(frame),
    toggle() {
      switchTo(!isOn);
      panel.send({ kind: "histogram", on: isOn });
      if (last) show(last);
    },
    toggleLog() {
      isLogarithmic = !isLogarithmic;
      if (last) show(last);
    },
    get isOn() { return isOn; },
    get isLogarithmic() { return isLogarithmic; },
    watch: (watcher) => watchers.push(watcher),
    isHeld: (name) => dragged === name,
  };
}
