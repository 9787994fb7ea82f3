// Numbers: how they are written, read from what was typed, and stepped.

/** How many steps a key with Shift takes. */
export const FAST = 10;

/** What stands before the decimals where the browser's user lives. */
const DECIMAL = new Intl.NumberFormat().formatToParts(1.5).find(({ type }) => type === "decimal")?.value ?? ".";

/** @typedef {{integer?: boolean, odd?: boolean, log?: boolean, low: (number | null)[], high: (number | null)[],
 *             step: (number | null)[], names: string[]}} NumberRow */

/** Return a number as a person writes it: 0.3 where adding up steps gives 0.30000000000000004. */
export function written(value) {
  return Number.isFinite(value) ? String(Number(value.toPrecision(12))) : String(value);
}

/** Return a duration with its unit; a dash for one that is not known. */
export function inMs(ms) {
  if (!Number.isFinite(ms)) return "–";
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
function asKind(row, value) {
  if (row.odd) return 2 * Math.floor(value / 2) + 1;
  return row.integer ? Math.round(value) : Number(value.toPrecision(12));
}

/** Return the ends that one value of a row must keep, its partner's value included. */
export function ends(row, index, values) {
  const lower = index > 0 ? values?.[index - 1] : undefined;
  const upper = index + 1 < row.names.length ? values?.[index + 1] : undefined;
  return {
    low: Math.max(row.low[index] ?? -Infinity, lower ?? -Infinity),
    high: Math.min(row.high[index] ?? Infinity, upper ?? Infinity),
  };
}

/** Return a value moved into the ends, still of the row's kind of number. */
export function clamped(row, index, value, values) {
  const { low, high } = ends(row, index, values);
  const kept = asKind(row, Math.min(Math.max(value, low), high));
  const step = row.odd ? 2 : 1;
  if (kept > high) return row.integer || row.odd ? kept - step : high;
  if (kept < low) return row.integer || row.odd ? kept + step : low;
  return kept;
}

/**
 * Read what was typed.
 * @param {NumberRow} row
 * @param {number} index of the value in its row
 * @param {string} text
 * @param {(number | undefined)[]} [values] of the whole row: a pair keeps its order
 * @returns {{value: number, notice?: string} | {problem: string}} A notice says that the value is not the typed one.
 */
export function read(row, index, text, values) {
  const name = row.names[index];
  const typed = text.trim();
  const value = Number(typed.replace(DECIMAL, "."));
  if (typed === "" || !Number.isFinite(value)) return { problem: `Type a number for ${name}${typed ? `, not ${typed}` : ""}.` };
  if ((row.integer || row.odd) && !Number.isInteger(value)) return { problem: `${name} takes whole numbers, not ${typed}.` };
  const { low, high } = ends(row, index, values);
  const asked = row.odd ? asKind(row, value) : value;
  if (asked < low || value > high) return { problem: `${name} can't be ${typed}: ${ranged(row, index, low, high)}.` };
  const taken = row.odd ? clamped(row, index, value, values) : value;
  return taken === value ? { value } : { value: taken, notice: `${name} takes odd numbers: ${typed} became ${taken}.` };
}

function ranged(row, index, low, high) {
  const whose = (end, partner, bound) => (end !== (bound ?? end) && partner ? ` (${partner})` : "");
  const least = `${written(low)}${whose(low, row.names[index - 1], row.low[index])}`;
  const most = `${written(high)}${whose(high, row.names[index + 1], row.high[index])}`;
  if (low === -Infinity) return `it is at most ${most}`;
  return high === Infinity ? `it is at least ${least}` : `its range is ${least} to ${most}`;
}

/** Return the distance of two values; on a logarithmic row that of two exponents of ten. */
export function stepOf(row, index) {
  if (row.log) return row.step[index] || 0.05;
  const span = (row.high[index] ?? NaN) - (row.low[index] ?? NaN);
  return row.step[index] || (row.integer ? 1 : span > 0 ? 10 ** Math.floor(Math.log10(span / 100)) : 0.1);
}

/** Return the value some steps away, within its ends. */
export function stepped(row, index, value, count, values) {
  const step = stepOf(row, index);
  if (!row.log || value <= 0) return clamped(row, index, value + Math.max(step, row.odd ? 2 : 0) * count, values);
  const moved = value * 10 ** (step * count);
  const away = row.integer && Math.round(moved) === value ? value + Math.sign(count) : Number(moved.toPrecision(6));
  return clamped(row, index, away, values);
}

/** Whether a slider at one value, which shows the nearest step only, can mean the other. */
export function means(row, index, position, exact) {
  if (position === exact) return true;
  if (typeof position !== "number" || typeof exact !== "number") return false;
  const distance = row.log ? Math.abs(Math.log10(position / exact)) : Math.abs(position - exact);
  return distance <= (stepOf(row, index) / 2) * (1 + 1e-9);
}

/** Return the value of a slider's model while its handles are at these places: no finer than its steps can tell. */
export function modelValue(row, handles) {
  const each = handles.map((place) => shownAt(row, row.log ? 10 ** place : place));
  return row.names.length > 1 ? each : each[0];
}

/** Return the number that a slider means at a place. */
export function shownAt(row, place) {
  if (row.integer) return Math.round(place);
  return row.log ? Number(place.toPrecision(4)) : place;
}

/** Whether two values that came as JSON are the same. */
export function same(one, other) {
  return one === other || JSON.stringify(one) === JSON.stringify(other);
}
