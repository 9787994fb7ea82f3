// Rates and durations of the last two minutes.
import { make, part } from "./server.js";

const KEPT_S = 120;
const WIDTH = 240, HEIGHT = 44, MARGIN = 3;
const NS_PER_MS = 1e6;
const LABELS = {
  received: "received", answered: "answered", failed: "failed", dropped: "dropped", dead_letters: "dead letters",
  retried: "tried again", rejected: "rejected", waiting: "waiting", in_flight: "in work",
};
// Where a broker delivers the events.
const OF_BROKER = { redelivered: "delivered again", duplicates: "duplicates", given_back: "given back" };
const BAD = new Set(["failed", "dropped", "dead_letters", "rejected"]);

/** @type {{at: number, ns: number}[]} */
let runs = [];
/** @type {{at: number, answered: number} | null} */
let last = null;
/** @type {Record<string, {at: number, value: number | null}[]>} */
const lines = { rate: [], p50: [], p95: [] };

/** Take note of how long a run took. @param {{total_ns?: number}} run */
export function sawRun(run) {
  if (typeof run.total_ns === "number") runs.push({ at: performance.now(), ns: run.total_ns });
}

/** Show what was counted, and what that makes per second. @param {Record<string, number>} counts */
export function sawCounts(counts) {
  const labels = Object.entries(OF_BROKER).filter(([name]) => name in counts);
  part("counts").replaceChildren(...[...Object.entries(LABELS), ...labels].map(([name, label]) => entry(label, counts[name] ?? 0, BAD.has(name))));
  const now = performance.now();
  // A service that was started anew counts from 0.
  if (last && counts.answered >= last.answered && now - last.at > 300) {
    note("rate", ((counts.answered - last.answered) * 1000) / (now - last.at), (value) => `${perSecond(value)} /s`);
    const recent = runs.filter((run) => now - run.at < 5000).map((run) => run.ns).sort((a, b) => a - b);
    note("p50", quantile(recent, 0.5), duration);
    note("p95", quantile(recent, 0.95), duration);
  }
  last = { at: now, answered: counts.answered };
  runs = runs.filter((run) => now - run.at < KEPT_S * 1000);
}

function entry(label, count, isBad) {
  return make("div", isBad && count > 0 ? { class: "bad" } : {}, make("dt", {}, label), make("dd", {}, count.toLocaleString("en")));
}

function quantile(sorted, share) {
  return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))] : null;
}

function note(name, value, written) {
  const now = performance.now();
  const line = (lines[name] = [...lines[name].filter((point) => now - point.at < KEPT_S * 1000), { at: now, value }]);
  part(name).textContent = value === null ? "–" : written(value);
  draw(part(`${name}-line`), line, now, written);
}

function draw(svg, line, now, written) {
  const values = line.map((point) => point.value).filter((value) => value !== null);
  const most = Math.max(...values, 0) || 1;
  const pieces = line.map(({ at, value }, index) => {
    if (value === null) return "";
    const x = WIDTH * (1 - (now - at) / (KEPT_S * 1000)), y = HEIGHT - MARGIN - (value / most) * (HEIGHT - 2 * MARGIN);
    return `${(line[index - 1]?.value ?? null) === null ? "M" : "L"}${x.toFixed(1)},${y.toFixed(1)}`;
  });
  svg.firstElementChild.setAttribute("d", pieces.join(""));
  svg.setAttribute("aria-label", values.length ? `From ${written(Math.min(...values))} to ${written(Math.max(...values))}` : "No values yet");
}

/** Return a rate as text: slow ones with a digit more. @param {number} rate */
export const perSecond = (rate) => rate.toFixed(rate < 10 ? 1 : 0);

function duration(ns) {
  const ms = ns / NS_PER_MS;
  if (ms < 1) return `${Math.round(ms * 1000)} µs`;
  return ms < 1000 ? `${ms.toPrecision(3)} ms` : `${(ms / 1000).toPrecision(3)} s`;
}
