// The wearer's page: joins the modules.

import { isFresh, startBeat } from "./age.js";
import { Alarms } from "./alarms.js";
import { degrees } from "./angles.js";
import { hold } from "./board_view.js";
import { AlarmBanner, showNotices } from "./banner.js";
import { measureOffset } from "./clock.js";
import { inkOn, personColour } from "./colours.js";
import { CompassSharing } from "./compass_sharing.js";
import { Connection } from "./connection.js";
import { arrow, byId, make, postJson, setAttribute, setText, storage } from "./dom.js";
import { FindView } from "./find_view.js";
import { LinkBanner } from "./link_banner.js";
import { stateWords } from "./people.js";
import { PressQueue, UNDO_MS } from "./queue.js";
import { Siren } from "./sound.js";
import { connectionWords, dataAgeS, replayWords, showConnection } from "./status_line.js";
import { Team } from "./team.js";
import { isDark, themeSwitch } from "./theme_switch.js";
import { ScreenLock } from "./wake_lock.js";
import { alarmText, clock, compass, distance, plusMinus, side, timeOfDay, directionWords } from "./words.js";

const CLOCK_EVERY_MS = 60_000;
const LIST_MS = 250;

const store = storage();
const team = new Team();
const alarms = new Alarms();
const queue = new PressQueue(store);
const others = new Map();
let me = readMe();
let page = me ? "landmarks" : "me";
let receivedMs = null;
let offset = null; // {offsetMs, roundTripMs, atMs}
let comparing = false;
let sending = false;
let sendTrouble = "";
let listMs = -Infinity;
let lastPress = null;
let trouble = null;

const siren = new Siren(showSound);
const link = new LinkBanner(byId("link"), byId("alarm-voice"), () => sound());
const banner = new AlarmBanner(byId("alarms"), {
  acknowledge,
  show: (node) => {
    if (node !== me?.node) startFinding(node);
  },
});
const lock = new ScreenLock(showLock);
const sharing = new CompassSharing(showCompass);
const findView = new FindView(byId("find"), { close: stopFinding, next: findNext });
const connection = new Connection({
  onMessage: handle,
  onState: (state) => {
    showAge();
    if (state === "live") {
      compareClocks(true);
      fetchWearers();
    }
  },
});

function readMe() {
  try {
    const read = JSON.parse(store.getItem("relpos.wearer") ?? "null");
    return Number.isInteger(read?.node) ? read : null;
  } catch {
    return null;
  }
}

// -- messages --------------------------------------------------------------------------------------

function handle(message) {
  const kind = team.handle(message);
  if (kind === "hello") {
    alarms.clear();
    trouble = null;
    introduce();
    document.title = `${team.session.name ?? "team"} · wearer${team.replayed ? " · REPLAY" : ""}`;
    setAttribute(document.documentElement, "data-replay", team.replayed ? "true" : null);
  } else if (kind === "board") {
    showOrders(message);
  } else if (kind === "picture") {
    receivedMs = Date.now();
    const { raised, cleared } = alarms.update(team.list());
    if (raised.length) setText(byId("alarm-voice"), raised.map((a) => `${a.level}: ${words(a)}`).join(". "));
    if (cleared.length) setText(byId("voice"), cleared.map((a) => `${a.name}: all clear`).join(". "));
    link.update(0, receivedMs);
    if (team.replayed && raised.length) siren.sound(null);
    sound();
    banner.update(alarms);
    findView.update(team);
    if (performance.now() - listMs > LIST_MS) showTeam();
  } else if (kind === "unknown") {
    trouble = { level: "warning", text: "The server's version differs from this page's: reload the page." };
  }
}

/** What the commander asks of me: to leave, to answer a roll call. */
function showOrders(board) {
  const node = me?.node;
  const { evacuation, roll_call: call } = board;
  const section = byId("orders");
  const answer = (kind, body) => postJson(`/api/${kind}`, { ...body, node, by: me.name }).catch((error) => {
    trouble = { level: "warning", text: `Not sent: ${error.message}` };
    showTeam();
  });
  const button = (text, action) => {
    const element = make("button", { type: "button", class: "main", text });
    element.addEventListener("click", action);
    return element;
  };
  const lines = [];
  if (node && evacuation?.nodes.includes(node)) {
    const seen = evacuation.acknowledged[node];
    if (!evacuation.delivered[node] && !seen) answer("evacuate", { action: "delivered" });
    lines.push(make("p", { class: "evacuation" }, seen ? "EVACUATE: understood" : "EVACUATE: leave now",
      ...(seen ? [] : [button("Understood", () => answer("evacuate", { action: "acknowledged" }))])));
  }
  if (node && call && call.ended_unix_s === null && call.nodes.includes(node) && !call.answers[node]) {
    lines.push(make("p", { class: "roll" }, "Roll call",
      button("I am all right", () => answer("rollcall", { action: "answer", answer: "confirmed" }))));
  }
  section.replaceChildren(...lines);
  section.hidden = !lines.length;
  if (lines.length) navigator.vibrate?.([400, 200, 400]);
}

function sound() {
  const kind = link.sounding ? "link" : alarms.sounding;
  siren.sound(kind && team.replayed ? "replay" : kind);
}

/** The age of what is shown counts on while nothing comes. */
function beat() {
  showAge();
  if (receivedMs === null) return;
  const lagS = Math.max(0, Date.now() - receivedMs) / 1000;
  link.update(lagS, receivedMs);
  if (!link.lost) return;
  team.age(lagS);
  alarms.update(team.list());
  banner.update(alarms);
  sound();
  findView.update(team, false);
  showTeam();
}

function words(alarm) {
  return alarm.node === me?.node && alarm.kind === "still" ? "You have not moved: move, or acknowledge" : alarmText(alarm);
}

function showTeam() {
  listMs = performance.now();
  showAge();
  showNotices(byId("notices"), [...(trouble ? [trouble] : []), ...team.notices]);
  byId("team-empty").hidden = team.pictures > 0;
  showMe();
  const list = team.list()
    .filter((person) => person.node !== me?.node)
    .map((person) => ({ person, relation: me ? team.relation(me.node, person.node) : null }));
  const wanted = new Set(list.map(({ person }) => person.node));
  for (const [node, row] of others) {
    if (!wanted.has(node)) {
      row.element.remove();
      others.delete(node);
    }
  }
  const { here } = team.possible();
  list.forEach(({ person, relation }) => {
    let row = others.get(person.node);
    if (!row) {
      row = makeOther(person.node);
      others.set(person.node, row);
      byId("others").append(row.element);
    }
    const alarm = alarms.active.get(person.node);
    setAttribute(row.element, "data-alert", alarm?.level ?? null);
    row.disc.style.background = colourOf(person.node);
    row.disc.style.color = inkOn(colourOf(person.node));
    setText(row.name, person.name);
    row.arrow.point(relation?.relativeRad ?? null);
    setText(row.far, relation ? `${distance(relation.distanceM, relation.sigmaM)} ` : "–");
    const fresh = isFresh(person) && isFresh(team.person(me?.node));
    setAttribute(row.element, "data-status", person.status);
    setText(row.sigma, !relation ? "" : fresh ? plusMinus(relation.sigmaM) : "to the last place");
    setText(row.where, !relation ? (me ? "position unknown" : "say who you are first")
      : relation.relativeRad === null
        ? `${directionWords(relation)} · ${compass(relation.bearingRad, team.northRad)}`
        : `${clock(relation.relativeRad)}, ${side(relation.relativeRad)}`);
    setText(row.state, stateWords(person, alarm, here.get(person.node)));
    row.find.disabled = !me;
    setAttribute(row.find, "aria-label", `Find ${person.name}`);
  });
}

function makeOther(node) {
  const row = {
    arrow: arrow("small-arrow"), disc: make("span", { class: "disc", text: String(node) }), name: make("span"),
    far: make("span", { class: "far" }), sigma: make("span", { class: "soft" }), where: make("p"),
    state: make("p", { class: "state" }), find: make("button", { type: "button", text: "Find" }),
  };
  row.find.addEventListener("click", () => startFinding(node));
  row.element = make("li", { class: "other", "data-node": node }, row.arrow.element,
    make("div", {}, make("p", { class: "title" }, row.disc, row.name), make("p", {}, row.far, row.sigma), row.where, row.state),
    row.find);
  return row;
}

function colourOf(node) {
  return link.lost ? "#777777" : personColour(node, isDark());
}

function showMe() {
  const name = (me && team.person(me.node)?.name) ?? me?.name;
  setText(byId("my-name"), me ? name : "Who are you?");
  const disc = byId("disc");
  disc.hidden = !me;
  if (me) {
    setText(disc, String(me.node));
    disc.style.background = colourOf(me.node);
    disc.style.color = inkOn(colourOf(me.node));
  }
}

function showAge() {
  const age = dataAgeS({ unixS: team.unixS, arrivedUnixS: team.arrivedUnixS, receivedMs, nowMs: Date.now() });
  const status = team.replayed ? replayWords(connection.state, team.session, team.timeS)
    : connectionWords(connection.state, age, connection.retryS);
  showConnection({ line: byId("connection"), words: byId("connection-words"), age: byId("age"), retry: byId("retry") }, status);
}

async function acknowledge(nodes) {
  const by = me?.name ?? "a phone";
  for (const node of nodes) alarms.acknowledge(node, by);
  sound();
  banner.update(alarms);
  try {
    for (const node of nodes) await postJson("/api/acknowledge", { node, by });
  } catch (error) {
    trouble = { level: "warning", text: `Acknowledged only on this phone: ${error.message}` };
  }
}

// -- finding ---------------------------------------------------------------------------------------

function startFinding(node) {
  if (!me) return open("me");
  findView.start(me.node, node);
  findView.update(team, !link.lost);
  scrollTo(0, 0);
  return undefined;
}

function stopFinding() {
  const { to } = findView;
  findView.stop();
  open("team");
  others.get(to)?.find.focus();
}

function findNext(by) {
  const nodes = team.order.filter((n) => n !== me?.node);
  const at = nodes.indexOf(findView.to);
  if (nodes.length) startFinding(nodes[(at + by + nodes.length) % nodes.length]);
}

// -- landmarks -------------------------------------------------------------------------------------

const field = byId("landmark");
let downMs = null;

function addDigit(digit) {
  if (field.value.length < field.maxLength) field.value += digit;
  field.dispatchEvent(new Event("input"));
}

function makePad() {
  const pad = byId("pad");
  const button = (text, action, attributes = {}) => {
    const key = make("button", { type: "button", text, ...attributes });
    key.addEventListener("click", action);
    pad.append(key);
  };
  for (const digit of "123456789") button(digit, () => addDigit(digit));
  button("Clear", () => {
    field.value = "";
    field.dispatchEvent(new Event("input"));
  }, { class: "word" });
  button("0", () => addDigit("0"));
  button("⌫", () => {
    field.value = field.value.slice(0, -1);
    field.dispatchEvent(new Event("input"));
  }, { "aria-label": "Delete the last digit" });
}

function showPress() {
  const ready = me !== null && field.value !== "";
  const press = byId("press");
  press.disabled = !ready;
  setText(press, !me ? "Who are you?" : field.value ? `I am at ${field.value}` : "I am here");
}

function pressNow() {
  const landmark = field.value;
  if (!me || !landmark) return;
  // The press counts from the touch, not from the release.
  const now = Date.now();
  const unixMs = downMs !== null && now - downMs < 2000 ? downMs : now;
  downMs = null;
  lastPress = queue.press(me.node, landmark, offset?.offsetMs ?? null, unixMs);
  field.value = "";
  field.dispatchEvent(new Event("input"));
  siren.unlock();
  navigator.vibrate?.(60);
  setText(byId("voice"), `Landmark ${landmark} pressed`);
  showQueue();
}

function undo() {
  const undone = queue.undo();
  setText(byId("voice"), undone ? `Landmark ${undone.landmark} undone` : "Too late to undo");
  if (undone) {
    lastPress = null;
    setText(byId("last"), `Landmark ${undone.landmark} at ${timeOfDay(undone.unix_ms)} was undone`);
  }
  showQueue();
}

function showQueue() {
  const waiting = queue.waiting;
  const line = byId("queue");
  const live = connection.state === "live";
  setAttribute(line, "data-state", waiting ? "waiting" : queue.acknowledged ? "sent" : "empty");
  const held = queue.newest && queue.isHeld(queue.newest);
  const count = (n) => (n === 1 ? "1 press" : `${n} presses`);
  let text;
  if (waiting) {
    text = `${count(waiting)} stored on this phone, ${live ? (held ? "sent in a moment" : "being sent") : "sent once connected"}`;
    if (sendTrouble) text += ` (${sendTrouble})`;
  } else {
    text = queue.acknowledged ? `${count(queue.acknowledged)} received by the laptop` : "No presses yet";
  }
  if (store.lasting === false && waiting) text += ". This browser stores nothing: do not close the page";
  setText(line, text);
  const leftMs = held ? UNDO_MS - (Date.now() - queue.newest.unix_ms) : 0;
  byId("undo").hidden = !held;
  if (held) {
    setText(byId("undo"), `Undo ${queue.newest.landmark} (${Math.ceil(leftMs / 1000)})`);
  }
  if (lastPress) setText(byId("last"), `Last: ${lastPress.landmark} at ${timeOfDay(lastPress.unix_ms)}`);
}

async function sendPresses() {
  if (sending || connection.state !== "live" || !offset) return;
  const batches = queue.batches(offset.offsetMs);
  if (!batches.length) return;
  sending = true;
  try {
    for (const batch of batches) {
      const { accepted } = await postJson("/api/presses", { ...batch, sent_unix_ms: Date.now() });
      queue.accepted(accepted);
    }
    sendTrouble = "";
  } catch (error) {
    sendTrouble = error.message;
  } finally {
    sending = false;
    showQueue();
  }
}

async function sendHeadings() {
  if (!me || !offset || connection.state !== "live" || sharing.kept.length === 0) return;
  const headings = sharing.takeAll();
  try {
    await postJson("/api/headings", { node: me.node, clock_offset_ms: offset.offsetMs, sent_unix_ms: Date.now(), headings });
    sharing.sent += headings.length;
  } catch (error) {
    sharing.putBack(headings);
    sharing.status = `Not sent: ${error.message}`;
  }
  showCompass();
}

async function compareClocks(now = false) {
  if (comparing || connection.state !== "live") return;
  if (!now && offset && Math.abs(Date.now() - offset.atMs) < CLOCK_EVERY_MS) return;
  comparing = true;
  try {
    const found = await measureOffset(async () => {
      const answer = await fetch("/api/time", { cache: "no-store" });
      return (await answer.json()).unix_ms;
    });
    if (found) {
      offset = { ...found, atMs: Date.now() };
      setText(byId("clock-status"), `The laptop's clock is ${Math.abs(found.offsetMs).toFixed(0)} ms ${found.offsetMs < 0 ? "behind" : "ahead of"} this phone's, within ${(found.roundTripMs / 2).toFixed(0)} ms.`);
    }
  } catch {
    // Not connected after all; tried again with the next tick.
  } finally {
    comparing = false;
  }
}

/** Send my name to a session that does not know it yet. */
async function introduce() {
  const session = team.session.started_unix_s ?? null;
  if (!me || me.session === session) return;
  try {
    await postJson("/api/name", { node: me.node, name: me.name });
    rememberMe({ ...me, session });
  } catch {
    // Sent with the next connection.
  }
}

function rememberMe(now) {
  me = now;
  store.setItem("relpos.wearer", JSON.stringify(me));
}

// -- who I am --------------------------------------------------------------------------------------

let chosen = me?.node ?? null;

async function fetchWearers() {
  let wearers;
  try {
    wearers = await (await fetch("/api/wearers", { cache: "no-store" })).json();
  } catch {
    return;
  }
  const list = byId("wearers");
  byId("wearers-empty").hidden = wearers.length > 0;
  const key = JSON.stringify([wearers, chosen, isDark()]);
  if (list.dataset.shown === key) return;
  list.dataset.shown = key;
  const focused = document.activeElement?.dataset?.wearer;
  list.replaceChildren(...wearers.map((wearer) => {
    const disc = make("span", { class: "disc", text: String(wearer.node), "aria-hidden": "true" });
    const colour = personColour(wearer.node, isDark());
    disc.style.background = colour;
    disc.style.color = inkOn(colour);
    const text = make("span", {}, wearer.name);
    if (wearer.taken && wearer.node !== me?.node) text.append(make("span", { class: "taken", text: "has a phone" }));
    const button = make("button", { type: "button", "data-wearer": wearer.node, "aria-pressed": String(wearer.node === chosen) }, disc, text);
    button.addEventListener("click", () => choose(wearer));
    return make("li", {}, button);
  }));
  if (focused) list.querySelector(`[data-wearer="${focused}"]`)?.focus();
}

function choose(wearer) {
  chosen = wearer.node;
  byId("name-form").hidden = false;
  byId("name").value = wearer.name;
  setText(byId("name-status"), "");
  for (const button of byId("wearers").querySelectorAll("button")) {
    setAttribute(button, "aria-pressed", String(Number(button.dataset.wearer) === chosen));
  }
  byId("name-form").scrollIntoView({ block: "nearest" });
}

byId("name-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const name = byId("name").value.trim() || `Node ${chosen}`;
  rememberMe({ node: chosen, name, session: null });
  showPress();
  showMe();
  try {
    await postJson("/api/name", { node: chosen, name });
    rememberMe({ ...me, session: team.session?.started_unix_s ?? null });
    setText(byId("name-status"), `You are ${name}, node ${me.node}.`);
    open("landmarks");
  } catch (error) {
    setText(byId("name-status"), `Stored on this phone, not sent to the laptop: ${error.message}`);
  }
  fetchWearers();
  showTeam();
});

// -- pages and settings ----------------------------------------------------------------------------

function open(name) {
  if (findView.open) findView.stop();
  page = name;
  for (const which of ["landmarks", "team", "me"]) byId(`page-${which}`).hidden = which !== page;
  for (const button of document.querySelectorAll("nav button")) {
    setAttribute(button, "aria-current", button.dataset.page === page ? "page" : null);
  }
  if (name === "me") fetchWearers();
  scrollTo(0, 0);
}

function showSound() {
  const state = { on: "Sound on", muted: "Sound off for 2 min", locked: "NO SOUND: enable" }[siren.state];
  setAttribute(byId("sound"), "data-state", siren.state);
  setText(byId("sound"), state);
  setAttribute(byId("sound"), "aria-pressed", String(siren.state === "on"));
}

function showLock() {
  const button = byId("wake");
  setAttribute(button, "aria-pressed", String(lock.on));
  button.disabled = !lock.possible;
  setText(byId("wake-status"), !lock.possible
    ? "Browsers keep the screen on only over HTTPS: change the phone's screen timeout instead."
    : lock.trouble || (lock.on ? "The screen stays on while this page is open." : ""));
}

function showCompass() {
  setAttribute(byId("compass"), "aria-pressed", String(sharing.on));
  setText(byId("compass"), sharing.on ? "Sharing compass" : "Share compass");
  const status = byId("compass-status");
  if (sharing.status) setText(status, sharing.status);
  else if (sharing.on && sharing.newest) {
    const deg = ((450 - degrees(sharing.newest.heading_rad)) % 360).toFixed(0);
    setText(status, `Heading ${deg}° from magnetic north, ±${degrees(sharing.newest.sigma_rad).toFixed(0)}°; ${sharing.sent} sent.`);
  } else {
    setText(status, CompassSharing.obstacle() ||
      "Hold or wear the phone pointing ahead, flat or upright, screen towards you.");
  }
}

hold(byId("mayday"), () => {
  if (!me) return open("me");
  return postJson("/api/mayday", { node: me.node, on: true, by: me.name }).then(
    () => setText(byId("last"), "MAYDAY was sent"),
    (error) => setText(byId("last"), `MAYDAY NOT SENT: ${error.message}. Use the radio.`));
});
makePad();
field.addEventListener("input", () => {
  field.value = field.value.replace(/\D/g, "");
  showPress();
});
field.addEventListener("keydown", (event) => {
  if (event.key === "Enter") pressNow();
});
const pressButton = byId("press");
pressButton.addEventListener("pointerdown", () => {
  downMs = Date.now();
});
pressButton.addEventListener("click", pressNow);
byId("undo").addEventListener("click", undo);
for (const button of document.querySelectorAll("nav button")) {
  button.addEventListener("click", () => open(button.dataset.page));
}
byId("compass").addEventListener("click", () => (sharing.on ? sharing.stop() : sharing.start()));
byId("wake").addEventListener("click", () => lock.set(!lock.on));
byId("sound").addEventListener("click", () => {
  if (siren.state === "locked") siren.test();
  else siren.mute(!siren.muted);
});
byId("retry").addEventListener("click", () => connection.wake());
themeSwitch(byId("theme"), () => {
  showMe();
  showTeam();
});
open(page);
showPress();
showQueue();
showSound();
showLock();
showCompass();
setInterval(() => {
  showQueue();
  compareClocks();
  sendPresses();
  sendHeadings();
  if (page === "me") fetchWearers();
}, 1000);
startBeat(beat);
connection.start();
