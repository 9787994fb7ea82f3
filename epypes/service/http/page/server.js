// Requests to the service, its stream of events, and what all parts of the page are made with.

const KEY = "epypes-access-key";
const AGAIN_MS = 2000;

/** What the service refused: a sentence, the status (0 if there was no answer), and what came with it. */
export class Refused extends Error {
  /** @param {number} status @param {Record<string, any>} data */
  constructor(status, data) {
    super(String(data.detail ?? `The service answered ${status}.`));
    this.status = status;
    this.data = data;
  }
}

/** Return the access key of the link that `epypes serve` prints, and take it out of the address bar and the history. */
export function takeKey() {
  const query = new URLSearchParams(location.search);
  // It was printed as #token=... once.
  const given = query.get("access_key") || new URLSearchParams(location.hash.slice(1)).get("token");
  if (!given) return null;
  query.delete("access_key");
  history.replaceState(null, "", location.pathname + (query.size ? `?${query}` : ""));
  return given;
}

/** Throws Refused if it is not the access key of the service. */
export const requireKey = () => ask("v1/access", "POST", {});

export function keepKey(key) {
  if (key) sessionStorage.setItem(KEY, key.trim());
  else sessionStorage.removeItem(KEY);
}

export const hasKey = () => sessionStorage.getItem(KEY) !== null;

/**
 * Ask for anything; throws Refused.
 * @param {string} path @param {RequestInit} [options] @returns {Promise<Response>}
 */
export async function request(path, options = {}) {
  const answer = await fetch(path, options).catch(() => {
    throw new Refused(0, { detail: "The service can't be reached. Is it still running?" });
  });
  if (!answer.ok) throw new Refused(answer.status, await answer.json().catch(() => ({})));
  return answer;
}

/**
 * Ask for JSON; throws Refused.
 * @param {string} path @param {string} [method] @param {unknown} [body] @returns {Promise<any>}
 */
export async function ask(path, method = "GET", body = undefined) {
  const headers = {};
  if (body !== undefined) headers["Content-Type"] = "application/json";
  if (method !== "GET" && hasKey()) headers.Authorization = `Bearer ${sessionStorage.getItem(KEY)}`;
  return (await request(path, { method, headers, body: JSON.stringify(body) })).json().catch(() => ({}));
}

/**
 * Hear of the service as long as the page is open; it is asked again when it has gone away.
 * @param {Record<string, (data: any) => void>} on by kind of event
 * @param {(isHeard: boolean) => void} onChange
 */
export function hear(on, onChange) {
  const source = new EventSource("v1/events");
  source.onopen = () => onChange(true);
  source.onerror = () => {
    onChange(false);
    if (source.readyState === EventSource.CLOSED) setTimeout(() => hear(on, onChange), AGAIN_MS);
  };
  for (const [kind, listener] of Object.entries(on)) source.addEventListener(kind, (event) => listener(JSON.parse(event.data)));
}

/** Make an element. @returns {any} */
export function make(tag, attributes = {}, ...inside) {
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, String(value));
  made.append(...inside);
  return made;
}

/** Make the entries of a list of names and texts; those without a text are left out. */
export function entries(facts) {
  return Object.entries(facts).filter(([, text]) => text).map(([name, text]) => make("div", {}, make("dt", {}, name), make("dd", {}, text)));
}

/** @returns {any} */
export const part = (id) => document.getElementById(id);

/** Say something, or nothing, in a notice. */
export function say(id, text, isError = true) {
  const notice = part(id);
  notice.textContent = text;
  notice.hidden = !text;
  notice.classList.toggle("error", isError);
}

/** Ask the user in a dialog, or only show something if there is nothing to answer; resolves to whether it is to be done. */
export function confirmed(title, body, yes = "") {
  const dialog = part("ask");
  part("ask-title").textContent = title;
  part("ask-body").replaceChildren(body);
  part("ask-yes").textContent = yes;
  part("ask-yes").hidden = !yes;
  part("ask-no").textContent = yes ? "Cancel" : "Close";
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true }));
}
