// The table of the replicas that share the events.
import { perSecond } from "./rates.js";
import { make, part } from "./server.js";

const DIGITS = 12;

/**
 * @typedef {{replica: string, host: string, pid: number, state: string, reason: string, digest: string, revision: number,
 *   counts: Record<string, number>, http: string, trouble: string, heard_s: number, is_self: boolean}} Member
 * @typedef {{replicas: number, ready: number, agree: boolean, counts: Record<string, number>, trouble: string, members: Member[], lost: Member[]}} Group
 */

/** @type {Map<string, {answered: number, at: number, rate: number | null}>} */
let seen = new Map();

/** @param {Group} group @param {Record<string, string>} tones by state */
export function sawGroup(group, tones) {
  part("replicas-section").hidden = group.replicas < 2 && !group.trouble && !group.lost.length;
  const note = [`${group.ready} of ${group.replicas} are ready; together they have answered ${counted(group.counts.answered)} events.`];
  if (!group.agree) note.push("They do not all serve the same bundle with the same parameters just now.");
  if (group.trouble) note.push(`The others are not heard: ${group.trouble}`);
  part("replicas-note").textContent = note.join(" ");
  part("replicas-note").classList.toggle("warn", !group.agree || Boolean(group.trouble));
  const now = new Map();
  const here = group.members.find((member) => member.is_self)?.host;
  const rows = group.members.map((member) => row(member, rate(member, now), tones, isReached(member, here)));
  rows.push(...group.lost.map((member) => row(member, null, tones, false)));
  seen = now;
  part("replicas").tBodies[0].replaceChildren(...rows);
}

const counted = (count = 0) => count.toLocaleString();

/** Return how many events a replica answers per second. */
function rate(member, now) {
  const key = `${member.host} ${member.pid} ${member.replica}`;
  const before = seen.get(key);
  const answered = member.counts.answered ?? 0;
  const at = performance.now() - member.heard_s * 1000;
  // It says how many each second; what was said is not older for being shown again.
  const isNews = !before || at - before.at > 300;
  const found = before && isNews && answered >= before.answered ? ((answered - before.answered) * 1000) / (at - before.at) : before?.rate ?? null;
  now.set(key, isNews ? { answered, at, rate: found } : before);
  return found;
}

/** Return whether another replica's page can be opened from here; one on another machine may listen there alone. */
function isReached(member, here) {
  if (member.is_self || !/^https?:/.test(member.http)) return false;
  return member.host === here || !/^https?:\/\/(127\.|localhost|\[::1\])/.test(member.http);
}

function row(member, answeredPerSecond, tones, isLinked) {
  const { counts } = member;
  const name = make("th", { scope: "row" }, isLinked ? make("a", { href: member.http }, member.replica) : member.replica);
  if (member.is_self) name.append(" ", make("small", {}, "this one"));
  const state = make("td", {}, make("span", { class: `badge ${tones[member.state] ?? ""}` }, member.state));
  const why = [member.reason, member.trouble].filter(Boolean).join(" ");
  if (why) state.append(make("div", { class: "quiet message" }, why));
  const numbers = {
    Revision: String(member.revision),
    "Answered per second": answeredPerSecond === null ? "–" : perSecond(answeredPerSecond),
    Answered: counted(counts.answered),
    Failed: counted((counts.failed ?? 0) + (counts.dead_letters ?? 0)),
  };
  return make(
    "tr",
    {},
    name,
    state,
    make("td", {}, `${member.host}, process ${member.pid}`),
    make("td", {}, make("code", {}, member.digest.slice(0, DIGITS))),
    ...Object.entries(numbers).map(([label, text]) => make("td", { class: "number", "data-label": label }, text)),
  );
}
