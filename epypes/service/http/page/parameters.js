// The fields of the parameters: what the service has, and what is changed here.
import { ask, confirmed, hasKey, make, part, say } from "./server.js";

const STEPS = 200;

/** @typedef {{value?: any, kind?: string, type?: string, low?: number, high?: number, soft?: number[], step?: number, odd?: boolean, choices?: any[], unit?: string}} Entry */
/** @typedef {{entry: Entry, box: HTMLElement, note: HTMLElement, read: () => any, write: (value: any) => void}} Field */

/** @type {Map<string, Field>} by token */
const fields = new Map();
let revision = 0;

/** Let the buttons work. */
export function watchParameters() {
  part("parameters").addEventListener("submit", (event) => {
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
  const [wanted, before] = [changes(), values()];
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

/** Show which buttons can be used, and why the others can't. */
export function showButtons() {
  const count = changes().size;
  part("apply").disabled = !count || !hasKey();
  part("undo").disabled = !count;
  part("write-back").disabled = !hasKey() || count > 0;
  part("apply").textContent = count ? `Apply ${count}` : "Apply";
  const why = [];
  if (!count) why.push("Apply and Undo: nothing is changed here.");
  else if (hasKey()) why.push("Write back: apply or undo the changes first.");
  if (!hasKey()) why.push(count ? "Apply and Write back need the access key." : "Write back needs the access key.");
  part("parameters-why").textContent = why.join(" ");
}

/** What was changed here, by token. */
function changes() {
  const read = [...fields].map(([token, field]) => [token, field.read()]);
  return new Map(read.filter(([token, value]) => !same(value, valueOf(fields.get(token).entry))));
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
    refuse(error, wanted, before);
  }
}

/** What is in the service, as far as it is known here, by token. */
const values = () => new Map([...fields].map(([token, field]) => [token, valueOf(field.entry)]));

/** @param {Refused} error @param {Map<string, any>} wanted @param {Map<string, any>} before */
function refuse(error, wanted, before) {
  if (error.status === 409 && error.data.parameters) {
    sawParameters(error.data);
    // They may have been told of before the refusal came.
    const theirs = [...values()].filter(([token, value]) => !same(before.get(token), value)).map(([token, value]) => `${token}: ${text(before.get(token))} → ${text(value)}`);
    say("parameters-note", `Another client changed the parameters meanwhile, so nothing was applied. They are loaded anew (${theirs.join("; ")}). Yours are marked; apply again to use them.`, false);
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
  for (const [token, field] of fields) {
    field.write(valueOf(field.entry));
    mark(token);
  }
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
    say("parameters-note", error.message);
  }
}

function painted(diff) {
  const kinds = new Map([["+", "added"], ["-", "removed"]]);
  return make("pre", { tabindex: "0" }, ...diff.split("\n").map((line) => make("span", { class: kinds.get(line[0]) ?? "" }, `${line}\n`)));
}

/** Say below a field what is changed here, or what it may be. */
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

/**
 * Make what a parameter is edited with; what can't be read is read as undefined.
 * @param {Record<string, string>} named @param {Entry} entry
 */
function control(named, entry) {
  const value = valueOf(entry);
  if (Array.isArray(entry.choices)) return choice(named, entry.choices);
  if (typeof value === "number") return number(named, entry);
  if (typeof value === "boolean") {
    const box = make("input", { ...named, type: "checkbox", role: "switch" });
    return { controls: [box], read: () => box.checked, write: (next) => (box.checked = Boolean(next)) };
  }
  const box = make("input", { ...named, type: "text", class: "text", spellcheck: "false" });
  // What is no plain number, text or truth is written as JSON.
  const isText = typeof value === "string";
  return { controls: [box], read: () => (isText ? box.value : parsed(box.value)), write: (next) => (box.value = isText ? String(next) : JSON.stringify(next)) };
}

function choice(named, choices) {
  const select = make("select", { ...named, class: "text" });
  return {
    controls: [select],
    read: () => parsed(select.value),
    write(value) {
      const all = choices.some((each) => same(each, value)) ? choices : [...choices, value];
      select.replaceChildren(...all.map((each) => make("option", { value: JSON.stringify(each) }, text(each))));
      select.value = JSON.stringify(value);
    },
  };
}

function number(named, entry) {
  const { low, high, soft = [] } = entry;
  // A number of JavaScript doesn't say whether it may have a fraction: 1.0 is 1.
  const step = entry.step ?? (entry.odd ? 2 : entry.type === "int" ? 1 : undefined);
  const [from, to] = [low ?? soft[0], high ?? soft[1]];
  const limits = { ...(low === undefined ? {} : { min: low }), ...(high === undefined ? {} : { max: high }) };
  const box = make("input", { ...named, ...limits, type: "number", step: step ?? "any", required: "" });
  const controls = [box];
  if (from !== undefined && to !== undefined) {
    const slider = make("input", { min: from, max: to, type: "range", step: step ?? (to - from) / STEPS, "aria-label": `${named.id.slice("parameter-".length)}, slider` });
    slider.addEventListener("input", () => (box.value = slider.value));
    box.addEventListener("input", () => (slider.value = box.value));
    controls.unshift(slider);
  }
  return { controls, read: () => (box.value === "" ? undefined : Number(box.value)), write: (value) => controls.forEach((each) => (each.value = String(value))) };
}

function parsed(json) {
  try {
    return JSON.parse(json);
  } catch {
    return undefined;
  }
}

/** @param {Entry} entry */
const valueOf = (entry) => (entry?.kind === "none" ? null : entry?.value);
const same = (one, other) => JSON.stringify(one) === JSON.stringify(other);
const text = (value) => (typeof value === "string" ? value : JSON.stringify(value));
