// The fields of the parameters: what the service has, and what is changed here.
import { ask, confirmed, hasToken, make, part, Refused, say } from "./server.js";

const STEPS = 200;

/** @typedef {{value?: any, kind?: string, type?: string, low?: number, high?: number, soft?: number[], step?: number, odd?: boolean, choices?: any[], unit?: string}} Entry */
/** @typedef {{entry: Entry, box: HTMLElement, note: HTMLElement, read: () => any, write: (value: any) => void}} Field */

/** @type {Map<string, Field>} */
const fields = new Map();
let revision = 0;

/** Let the buttons work. */
export function watchParameters() {
  part("parameters").addEventListener("submit", (/** @type {Event} */ event) => {
    event.preventDefault();
    void apply();
  });
  part("undo").addEventListener("click", undo);
  part("write-back").addEventListener("click", () => void writeBack());
}

/**
 * Take the parameters as they are now. A field that was changed here keeps its value, and says what it is there.
 * @param {{revision: number, parameters: Record<string, Entry>}} now
 */
export function sawParameters(now) {
  const wanted = changes();
  const before = values();
  revision = now.revision;
  part("revision").textContent = `revision ${revision}`;
  if ([...fields.keys()].join("\n") !== Object.keys(now.parameters).join("\n")) {
    fields.clear();
    for (const [token, entry] of Object.entries(now.parameters)) fields.set(token, made(token, entry));
    part("fields").replaceChildren(...[...fields.values()].map((field) => field.box));
  }
  for (const [token, field] of fields) {
    field.entry = now.parameters[token];
    const value = valueOf(field.entry);
    if (!wanted.has(token)) field.write(value);
    else if (!same(before.get(token), value)) field.note.dataset.meanwhile = "yes";
    mark(token);
  }
}

/** Show which buttons can be used. */
export function showButtons() {
  const isChanged = changes().size > 0;
  part("apply").disabled = !isChanged || !hasToken();
  part("undo").disabled = !isChanged;
  part("write-back").disabled = !hasToken() || isChanged;
  part("apply").textContent = isChanged ? `Apply ${changes().size}` : "Apply";
}

/** @returns {Map<string, any>} what was changed here, by token */
function changes() {
  const found = new Map();
  for (const [token, field] of fields) {
    const value = field.read();
    if (!same(value, valueOf(field.entry))) found.set(token, value);
  }
  return found;
}

async function apply() {
  const wanted = changes();
  if (!wanted.size) return;
  const before = values();
  const invalid = [...wanted].filter(([, value]) => value === undefined).map(([token]) => token);
  if (invalid.length) return say("parameters-note", `This can't be read: ${invalid.join(", ")}.`);
  try {
    const now = await ask("v1/parameters", "PATCH", { revision, values: Object.fromEntries(wanted) });
    for (const [token, field] of fields) if (wanted.has(token)) field.entry = now.parameters[token];
    say("parameters-note", "");
    sawParameters(now);
  } catch (error) {
    refuse(/** @type {Refused} */ (error), wanted, before);
  }
}

/** @returns {Map<string, any>} what is in the service, as far as it is known here, by token */
function values() {
  return new Map([...fields].map(([token, field]) => [token, valueOf(field.entry)]));
}

/** @param {Refused} error @param {Map<string, any>} wanted @param {Map<string, any>} before */
function refuse(error, wanted, before) {
  if (error.status === 409 && error.data.parameters) {
    sawParameters(error.data);
    // They may have been told of before the refusal came.
    const theirs = [...values()]
      .filter(([token, value]) => !same(before.get(token), value))
      .map(([token, value]) => `${token}: ${text(before.get(token))} → ${text(value)}`);
    say("parameters-note", `Somebody else changed the parameters meanwhile, so nothing was applied. They are loaded anew (${theirs.join("; ")}). Yours are marked; apply again to use them.`, false);
    return;
  }
  say("parameters-note", error.message);
  for (const [token, problem] of Object.entries(error.data.problems ?? {})) {
    const field = fields.get(token);
    if (!field || !wanted.has(token)) continue;
    field.box.classList.add("refused");
    field.note.textContent = String(problem);
  }
}

function undo() {
  for (const field of fields.values()) field.write(valueOf(field.entry));
  for (const token of fields.keys()) mark(token);
  say("parameters-note", "");
}

async function writeBack() {
  try {
    const { diff } = await ask("v1/parameters/write-back", "POST", { dry_run: true });
    if (!diff) return say("parameters-note", "pipeline.toml has these values already.", false);
    if (!(await confirmed("Write these values into pipeline.toml?", painted(diff), "Write"))) return;
    const { digest } = await ask("v1/parameters/write-back", "POST", { dry_run: false });
    say("parameters-note", `Written. The bundle has the digest ${digest.slice(0, 12)} now.`, false);
  } catch (error) {
    say("parameters-note", /** @type {Error} */ (error).message);
  }
}

/** @param {string} diff */
function painted(diff) {
  const kinds = new Map([["+", "added"], ["-", "removed"]]);
  return make("pre", { tabindex: "0" }, ...diff.split("\n").map((line) => make("span", { class: kinds.get(line[0]) ?? "" }, `${line}\n`)));
}

/** @param {string} token */
function mark(token) {
  const field = fields.get(token);
  if (!field) return;
  const value = field.read(), there = valueOf(field.entry);
  const isChanged = !same(value, there);
  field.box.classList.toggle("changed", isChanged);
  field.box.classList.remove("refused");
  if (!isChanged) delete field.note.dataset.meanwhile;
  const meanwhile = field.note.dataset.meanwhile ? "changed by another client meanwhile, " : "";
  field.note.textContent = isChanged ? `● ${meanwhile}${text(there)} in the service` : about(field.entry);
  showButtons();
}

/** @param {Entry} entry */
function about(entry) {
  const range = entry.low !== undefined && entry.high !== undefined ? `${entry.low} to ${entry.high}` : "";
  return [range, entry.odd ? "odd" : "", entry.unit ?? ""].filter(Boolean).join(", ");
}

/** @param {string} token @param {Entry} entry @returns {Field} */
function made(token, entry) {
  const id = `parameter-${token}`;
  const note = make("span", { class: "note", id: `${id}-note` });
  const described = { id, "aria-describedby": `${id}-note` };
  const { controls, read, write } = control(described, entry);
  const box = make("div", { class: "field" }, make("label", { for: id }, token), ...controls, note);
  box.addEventListener("input", () => mark(token));
  return { entry, box, note, read, write };
}

/** @param {Record<string, string>} named @param {Entry} entry */
function control(named, entry) {
  const value = valueOf(entry);
  if (Array.isArray(entry.choices)) return choice(named, entry.choices);
  if (typeof value === "boolean") return toggle(named);
  if (typeof value === "number") return number(named, entry);
  return typed(named, typeof value === "string");
}

/** @param {Record<string, string>} named @param {any[]} choices */
function choice(named, choices) {
  const select = /** @type {HTMLSelectElement} */ (make("select", { ...named, class: "text" }));
  const fill = (/** @type {any[]} */ all) => select.replaceChildren(...all.map((each) => make("option", { value: JSON.stringify(each) }, text(each))));
  fill(choices);
  return {
    controls: [select],
    read: () => JSON.parse(select.value),
    write: (/** @type {any} */ value) => {
      if (!choices.some((each) => same(each, value))) fill([...choices, value]);
      select.value = JSON.stringify(value);
    },
  };
}

/** @param {Record<string, string>} named */
function toggle(named) {
  const box = /** @type {HTMLInputElement} */ (make("input", { ...named, type: "checkbox", role: "switch" }));
  return { controls: [box], read: () => box.checked, write: (/** @type {any} */ value) => (box.checked = Boolean(value)) };
}

/** @param {Record<string, string>} named @param {Entry} entry */
function number(named, entry) {
  const { low, high, soft = [] } = entry;
  // A number of JavaScript doesn't say whether it may have a fraction: 1.0 is 1.
  const step = entry.step ?? (entry.odd ? 2 : entry.type === "int" ? 1 : undefined);
  const [from, to] = [low ?? soft[0], high ?? soft[1]];
  const limits = { ...(low === undefined ? {} : { min: String(low) }), ...(high === undefined ? {} : { max: String(high) }) };
  const box = /** @type {HTMLInputElement} */ (make("input", { ...named, ...limits, type: "number", step: String(step ?? "any"), required: "" }));
  const read = () => (box.value === "" ? undefined : Number(box.value));
  if (from === undefined || to === undefined) return { controls: [box], read, write: (/** @type {any} */ value) => (box.value = String(value)) };
  const slider = /** @type {HTMLInputElement} */ (
    make("input", { min: String(from), max: String(to), type: "range", step: String(step ?? (to - from) / STEPS), "aria-label": `${named.id.slice("parameter-".length)}, slider` })
  );
  slider.addEventListener("input", () => (box.value = slider.value));
  box.addEventListener("input", () => (slider.value = box.value));
  const write = (/** @type {any} */ value) => (slider.value = box.value = String(value));
  return { controls: [slider, box], read, write };
}

/** What is no plain number, text or truth is written as JSON. @param {Record<string, string>} named @param {boolean} isText */
function typed(named, isText) {
  const box = /** @type {HTMLInputElement} */ (make("input", { ...named, type: "text", class: "text", spellcheck: "false" }));
  const parsed = () => {
    try {
      return JSON.parse(box.value);
    } catch {
      return undefined;
    }
  };
  const write = (/** @type {any} */ value) => (box.value = isText ? String(value) : JSON.stringify(value));
  return { controls: [box], read: () => (isText ? box.value : parsed()), write };
}

/** @param {Entry} entry */
const valueOf = (entry) => (entry?.kind === "none" ? null : entry?.value);
/** @param {any} one @param {any} other */
const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);
/** @param {any} value */
const text = (value) => (typeof value === "string" ? value : JSON.stringify(value));
