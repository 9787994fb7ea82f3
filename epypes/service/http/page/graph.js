// The picture of the graph follows the runs, and a token is shown larger when it is chosen.
import { make, part, request } from "./server.js";

// A picture costs the worker some milliseconds; more of them could not be looked at.
const LEAST_MS = 400;
const TOKEN = "token-";
const STYLE = /<style>([^<]*)<\/style>/;
const LEAST_WIDTH = / style="min-width:([\d.]+px)"/;
// What the picture of a graph says at its end of one that has not been run.
const NOT_RUN = "not run yet";
const style = new CSSStyleSheet();

let isWanted = false;
let isAsked = false;
let looked = "";
let waits = "No event yet.";

/** Know where events are sent to, and whether any was answered. @param {string} address @param {boolean} isUsed */
export function sawPlace(address, isUsed) {
  waits = isUsed ? `No event since it was deployed, or its worker started again. They go to ${address}.` : `Waiting for the first event at ${address}.`;
  showNote();
}

function showNote() {
  const svg = part("graph").firstChild;
  if (!svg || part("graph").classList.contains("old")) return;
  const hasRun = !(svg.getAttribute("aria-label") ?? "").endsWith(NOT_RUN);
  part("graph-note").textContent = hasRun ? "Choose a token to see it larger." : waits;
}

/** Have the picture drawn anew: one request is in flight, and the latest wish wins. */
export function redraw() {
  isWanted = true;
  if (!isAsked && !document.hidden) void follow();
}

/** Draw while the page is visible, and show a chosen token larger. */
export function watchGraph() {
  document.adoptedStyleSheets = [...document.adoptedStyleSheets, style];
  document.addEventListener("visibilitychange", () => isWanted && redraw());
  const graph = part("graph");
  graph.addEventListener("click", (event) => look(vertexOf(event)));
  graph.addEventListener("keydown", (event) => {
    const vertex = event.key === "Enter" || event.key === " " ? vertexOf(event) : null;
    if (vertex) event.preventDefault();
    look(vertex);
  });
  const dialog = part("look");
  // The event of a closing comes later, and by then another token may have been chosen.
  dialog.addEventListener("close", () => dialog.open || (looked = ""));
}

async function follow() {
  isAsked = true;
  while (isWanted && !document.hidden) {
    isWanted = false;
    const start = performance.now();
    await draw();
    if (looked) await show(looked);
    const took = performance.now() - start;
    await new Promise((resolve) => setTimeout(resolve, Math.max(LEAST_MS, 2 * took) - took));
  }
  isAsked = false;
}

async function draw() {
  try {
    await swap(await (await request("v1/graph.svg")).text());
    part("graph").classList.remove("old");
    showNote();
  } catch (error) {
    part("graph").classList.add("old");
    part("graph-note").textContent = part("graph").firstChild ? "This picture is old: the service gives no newer one." : error.message;
  }
}

/** The picture takes the place of the one before once its images are decoded, so that nothing flickers. */
async function swap(text) {
  const svg = new DOMParser().parseFromString(withoutStyle(text), "image/svg+xml").documentElement;
  if (svg.nodeName !== "svg") throw new Error("The service sent no picture.");
  await Promise.all([...svg.querySelectorAll("image")].map((image) => decoded(image.getAttribute("href") ?? "")));
  const least = LEAST_WIDTH.exec(text)?.[1];
  const shown = document.importNode(svg, true);
  if (least) shown.style.minWidth = `min(${least}, 100vw)`;
  for (const vertex of shown.querySelectorAll(`[id^=${TOKEN}]`)) {
    vertex.setAttribute("tabindex", "0");
    vertex.setAttribute("role", "button");
  }
  const focused = document.activeElement?.closest?.(`#graph [id^=${TOKEN}]`)?.id;
  part("graph").replaceChildren(shown);
  if (focused) part(focused)?.focus();
}

/** Return an image once it can be shown. */
async function decoded(src, alt = "") {
  const image = Object.assign(new Image(), { src, alt });
  await image.decode().catch(() => undefined);
  return image;
}

/** The page's policy knows no styles inside a document, so those of the picture become a sheet of the page. */
function withoutStyle(text) {
  const inside = STYLE.exec(text);
  if (inside) style.replaceSync(inside[1]);
  return text.replace(STYLE, "").replace(LEAST_WIDTH, "");
}

const vertexOf = (event) => event.target?.closest?.(`[id^=${TOKEN}]`) ?? null;

/** Return the name in an id, where signs stand as ":2e:". */
const named = (id) => id.replace(/:([0-9a-f]+):/g, (_, code) => String.fromCodePoint(parseInt(code, 16)));

function look(vertex) {
  if (!vertex) return;
  looked = named(vertex.id.slice(TOKEN.length));
  part("look-title").textContent = looked;
  part("look-body").replaceChildren();
  part("look").showModal();
  void show(looked);
}

async function show(token) {
  const next = await preview(token).catch((error) => make("pre", {}, error.message));
  if (looked === token) part("look-body").replaceChildren(next);
}

async function preview(token) {
  const answer = await request(`v1/tokens/${encodeURIComponent(token)}/preview?max_side_px=1024`);
  if ((answer.headers.get("Content-Type") ?? "").startsWith("text/")) return make("pre", {}, await answer.text());
  const url = URL.createObjectURL(await answer.blob());
  const image = await decoded(url, `The value of ${token} in the latest run`);
  URL.revokeObjectURL(url);
  return image;
}
