// How is a number written, read from what was typed, and stepped?

/** How many steps a key with Shift takes. */
export const FAST = 10;

/** @typedef {{integer?: boolean, odd?: boolean, log?: boolean, low: (number | null)[], high: (number | null)[],
 *             step: (number | null)[], names: string[]}} NumberRow */

/** Return a number as a hand would write it: 0.3 where adding up steps gives 0.30000000000000004. */
export function written(value) {
  if (typeof value !== "number" || !Number.isFinite(value)) return String(value);
  return String(Number(value.toPrecision(12)));
}

/** Return a duration with its unit; a dash for one that is not known. */
export function inMs(ms) {
  if (ms === null || ms === undefined || !Number.isFinite(ms)) return "–";
  if (ms >= 10000) return `${(ms / 1000).toFixed(1)} s`;
  return `${ms < 100 ? ms.toFixed(1) : Math.round(ms)} ms`;
}

/** Return any value as short text. */
export function shortly(value) {
  if (typeof value === "number") return written(value);
  const text = typeof value === "string" ? value : JSON.stringify(value);
  return text && text.length > 40 ? `${text.slice(0, 39)}…` : String(text);
}

/** Return the nearest value that the row's kind of number has: whole, odd, or any. */
export function asKind(row, value) {
  if (row.odd) return 2 * Math.floor(value / 2) + 1;
  return row.integer ? Math.round(value) : Number(value.toPrecision(12));
}

/** Return the ends that one value of a row must keep, its partner's value included. */
export function ends(row, index, values) {
  let low = row.low?.[index] ?? -Infinity;
  let high = row.high?.[index] ?? Infinity;
  const lower = index > 0 ? values?.[index - 1] : undefined;
  const upper = index + 1 < row.names.length ? values?.[index + 1] : undefined;
  if (typeof lower === "number") low = Math.max(low, lower);
  if (typeof upper === "number") high = Math.min(high, upper);
  return { low, high };
}

/** Return a value moved into the ends, still of the row's kind of number. */
export function clamped(row, index, value, values) {
  const { low, high } = ends(row, index, values);
  let kept = asKind(row, Math.min(Math.max(value, low), high));
  const step = row.odd ? 2 : 1;
  if (kept > high) kept -= row.integer || row.odd ? step : kept - high;
  if (kept < low) kept += row.integer || row.odd ? step : low - kept;
  return kept;
}

/**
 * Read what was typed.
 * @param {NumberRow} row
 * @param {number} index of the value in its row
 * @param {string} text
 * @param {(number | undefined)[]} [values] of the whole row: a pair keeps its order
 * @returns {{value: number} | {problem: string}}
 */
export function read(row, index, text, values) {
  const name = row.names[index];
  const typed = text.trim().replace(/^([+-]?\d*),(\d+)$/, "$1.$2");
  const value = Number(typed);
  if (typed === "" || !Number.isFinite(value)) return { problem: `${name}: ${typed || "nothing"} is no number.` };
  if ((row.integer || row.odd) && !Number.isInteger(value)) return { problem: `${name} takes whole numbers, not ${typed}.` };
  const { low, high } = ends(row, index, values);
  const asked = row.odd ? asKind(row, value) : value;
  if (asked < low || (asked > high && value > high)) {
    return { problem: `${name} can't be ${typed}: ${ranged(row, index, low, high)}.` };
  }
  return { value: row.odd ? clamped(row, index, value, values) : value };
}

function ranged(row, index, low, high) {
  const whose = (end, partner, bound) => (end !== bound && partner ? ` (${partner})` : "");
  const least = `${written(low)}${whose(low, row.names[index - 1], row.low?.[index] ?? -Infinity)}`;
  const most = `${written(high)}${whose(high, row.names[index + 1], row.high?.[index] ?? Infinity)}`;
  if (low === -Infinity) return `it is at most ${most}`;
  return high === Infinity ? `it is at least ${least}` : `its range is ${least} to ${most}`;
}

/** Return the value some steps away, within its ends; the step of a logarithmic row is one of the power of ten. */
export function stepped(row, index, value, count, values) {
  const given = row.step?.[index];
  if (row.log && value > 0) {
    const moved = value * 10 ** ((given || 0.05) * count);
    const away = row.integer && Math.round(moved) === value ? value + Math.sign(count) : Number(moved.toPrecision(6));
    return clamped(row, index, away, values);
  }
  const step = Math.max(given || (row.integer ? 1 : spanStep(row, index)), row.odd ? 2 : 0);
  return clamped(row, index, value + step * count, values);
}

function spanStep(row, index) {
  const span = (row.high?.[index] ?? NaN) - (row.low?.[index] ?? NaN);
  return Number.isFinite(span) && span > 0 ? 10 ** Math.floor(Math.log10(span / 100)) : 0.1;
}

/** Whether a slider at one value, which shows the nearest step only, can mean the other. */
export function means(row, index, position, exact) {
  if (position === exact) return true;
  if (typeof position !== "number" || typeof exact !== "number") return false;
  const step = row.step?.[index] || (row.integer ? 1 : spanStep(row, index));
  const near = (row.log ? 0.5 * (row.step?.[index] || 0.05) : step / 2) * (1 + 1e-9);
  if (row.log) return position > 0 && exact > 0 && Math.abs(Math.log10(position / exact)) <= near;
  return Math.abs(position - exact) <= near;
}

/** Whether two values that came as JSON are the same. */
export function same(one, other) {
  return one === other || JSON.stringify(one) === JSON.stringify(other);
}
