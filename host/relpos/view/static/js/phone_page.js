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
import { arrow, byId, make, postJson, setAttribute, setHidden, setText, storage } from "./dom.js";
import { FindView } from "./find_view.js";
import { nameFloors } from "./floors.js";
import { languageSwitch, number, said, t } from "./i18n.js";
import { LinkBanner } from "./link_banner.js";
import { signOf } from "./marker.js";
import { stateWords } from "./people.js";
import { PressQueue, randomId, UNDO_MS } from "./queue.js";
import { Siren } from "./sound.js";
import { connectionWords, dataAgeS, replayWords, showConnection } from "./status_line.js";
import { Team } from "./team.js";
import { isDark, themeSwitch } from "./theme_switch.js";
import { ScreenLock } from "./wake_lock.js";
import { alarmText, clock, compass, directionWords, distance, levelWords, nodeName, plusMinus, side, timeOfDay } from "./words.js";

const CLOCK_EVERY_MS = 60_000;
const LIST_MS = 250;
const TROUBLE_MS = 60_000;
const MAYDAY_AGAIN_MS = 2000;
/** A page that is opened again so much later calls no more for whoever had it then. */
const MAYDAY_KEPT_MS = 15 * 60_000;
const MAYDAY = "relpos.mayday";

const store = storage();
const team = new Team();
const alarms = new Alarms();
const queue = new PressQueue(store);
const others = new Map();
let me = readMe();
let page = me ? "landmarks" : "me";
let offset = null; // {offsetMs, roundTripMs, atMs}
let comparing = false;
let sending = false;
let sendTrouble = "";
let listMs = -Infinity;
let lastPress = null;
let trouble = null;
let troubleTimer = null;
let orders = null;
let maydayHad = false;
let maydayTimer = null;

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
  restMs: LIST_MS,
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

function handle(message, ageS) {
  const kind = team.handle(message, ageS);
  if (kind === "hello") {
    alarms.clear();
    trouble = null;
    introduce();
    link.setTitle(t(team.replayed ? "title.wearer.replay" : "title.wearer", { name: team.session.name ?? "" }));
    setAttribute(document.documentElement, "data-replay", team.replayed ? "true" : null);
  } else if (kind === "board") {
    showOrders(message);
    nameFloors(message.floors);
  } else if (kind === "picture") {
    watchLink();
    const { raised, cleared } = alarms.update(team.list());
    if (raised.length) setText(byId("alarm-voice"), raised.map((a) => `${levelWords(a.level)}: ${words(a)}`).join(". "));
    if (cleared.length) setText(byId("voice"), cleared.map((a) => t("cleared.phone", { name: a.name })).join(". "));
    if (team.replayed && raised.length) siren.sound(null);
    sound();
    banner.update(alarms);
    findView.update(team);
    if (performance.now() - listMs > LIST_MS) showTeam();
  } else if (kind === "unknown") {
    trouble = { level: "warning", text: t("server.version") };
  }
}

/** Tell what went wrong here; after a while it is of the past. */
function say(text) {
  trouble = { level: "warning", text };
  clearTimeout(troubleTimer);
  troubleTimer = setTimeout(() => {
    trouble = null;
    showTeam();
  }, TROUBLE_MS);
  showTeam();
}

/** What the commander asks of me: to leave, to answer a roll call. */
function showOrders(board) {
  orders = board;
  const node = me?.node;
  // The session has it, whatever became of the answer.
  if (board.mayday?.[node]) {
    store.removeItem(MAYDAY);
    setText(byId("mayday-words"), t("mayday.sent"));
  } else if (maydayHad) setText(byId("mayday-words"), "");
  maydayHad = Boolean(board.mayday?.[node]);
  const { evacuation, roll_call: call } = board;
  const section = byId("orders");
  const answer = (kind, body) => postJson(`/api/${kind}`, { ...body, node, by: me.name })
    .catch((error) => say(t("sent.failed", { error: error.message })));
  const button = (key, action) => {
    const element = make("button", { type: "button", class: "main", "data-t": key });
    element.addEventListener("click", action);
    return element;
  };
  const asked = node && JSON.stringify([node, evacuation?.nodes.includes(node) && Boolean(evacuation.acknowledged[node]),
    call && call.ended_unix_s === null && call.nodes.includes(node) && !call.answers[node] && call.started_unix_s]);
  const delivered = Boolean(evacuation?.delivered[node] || evacuation?.acknowledged[node]);
  if (node && evacuation?.nodes.includes(node) && !delivered) answer("evacuate", { action: "delivered" });
  // What others answer changes nothing here: the button stays under the thumb.
  if (asked === section.dataset.asked) return;
  section.dataset.asked = asked;
  const lines = [];
  if (node && evacuation?.nodes.includes(node)) {
    const seen = evacuation.acknowledged[node];
    lines.push(make("p", { class: "evacuation" }, t(seen ? "evacuate.seen" : "evacuate.now"),
      ...(seen ? [] : [button("evacuate.understood", () => answer("evacuate", { action: "acknowledged" }))])));
  }
  if (node && call && call.ended_unix_s === null && call.nodes.includes(node) && !call.answers[node]) {
    lines.push(make("p", { class: "roll" }, t("roll"),
      button("roll.well", () => answer("rollcall", { action: "answer", answer: "confirmed" }))));
  }
  section.replaceChildren(...lines);
  setHidden(section, !lines.length);
  if (lines.length) navigator.vibrate?.([400, 200, 400]);
}

function sound() {
  const kind = link.sounding ? "link" : alarms.sounding;
  siren.sound(kind && team.replayed ? "replay" : kind);
}

function watchLink() {
  link.update(team.lagS, team.unixS);
  if (link.lost) team.age(team.lagS);
}

/** The age of what is shown counts on while nothing comes. */
function beat() {
  showAge();
  watchLink();
  if (!link.lost) return;
  alarms.update(team.list());
  banner.update(alarms);
  sound();
  findView.update(team, false);
  showTeam();
}

function words(alarm) {
  const own = alarm.node === me?.node ? { still: "alarm.me", fall: "alarm.me-fall" }[alarm.kind] : null;
  return own ? t(own) : alarmText(alarm);
}

function showTeam() {
  listMs = performance.now();
  showAge();
  showNotices(byId("notices"), [...(trouble ? [trouble] : []), ...team.notices.map((notice) => ({ ...notice, text: said(notice.said, notice.text) }))]);
  setHidden(byId("team-empty"), team.order.length > 0);
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
    setAttribute(row.element, "data-post", person.post ? "true" : null);
    setText(row.disc, signOf(person));
    setText(row.name, person.name);
    row.arrow.point(relation?.relativeRad ?? null);
    setText(row.far, relation ? `${distance(relation.distanceM, relation.sigmaM)} ` : "–");
    const fresh = isFresh(person) && isFresh(team.person(me?.node));
    setAttribute(row.element, "data-status", person.status);
    setText(row.sigma, !relation ? "" : fresh ? plusMinus(relation.sigmaM) : t("last.place"));
    setText(row.where, !relation ? (t(me ? "position.unknown" : "who.first"))
      : relation.relativeRad === null
        ? `${directionWords(relation)} · ${compass(relation.bearingRad, team.northRad)}`
        : `${clock(relation.relativeRad)}, ${side(relation.relativeRad)}`);
    setText(row.state, stateWords(person, alarm, here.get(person.node)));
    row.find.disabled = !me;
    setAttribute(row.find, "aria-label", t("find.name", { name: person.name }));
  });
}

function makeOther(node) {
  const row = {
    arrow: arrow("small-arrow"), disc: make("span", { class: "disc", text: String(node) }), name: make("span"),
    far: make("span", { class: "far" }), sigma: make("span", { class: "soft" }), where: make("p"),
    state: make("p", { class: "state" }), find: make("button", { type: "button", "data-t": "find" }),
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
  setText(byId("my-name"), me ? name : t("who"));
  const disc = byId("disc");
  setHidden(disc, !me);
  if (me) {
    setText(disc, String(me.node));
    disc.style.background = colourOf(me.node);
    disc.style.color = inkOn(colourOf(me.node));
  }
}

function showAge() {
  const age = team.arrivedUnixS === null ? null : dataAgeS({ unixS: team.unixS, arrivedUnixS: team.arrivedUnixS, receivedMs: team.viewedAt && 0, nowMs: 1000 * team.lagS });
  const status = team.replayed ? replayWords(connection.state, team.session, team.timeS)
    : connectionWords(connection.state, age, connection.retryS);
  showConnection({ line: byId("connection"), words: byId("connection-words"), age: byId("age"), retry: byId("retry") }, status);
}

async function acknowledge(nodes) {
  const by = me?.name ?? t("phone.some");
  const show = () => { sound(); banner.update(alarms); };
  try {
    await alarms.acknowledgeAll(nodes, by, (node) => postJson("/api/acknowledge", { node, by }), show);
  } catch (error) {
    say(t("acknowledge.failed", { error: error.message }));
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
  const button = (action, attributes) => {
    const key = make("button", { type: "button", ...attributes });
    key.addEventListener("click", action);
    pad.append(key);
  };
  for (const digit of "123456789") button(() => addDigit(digit), { text: digit });
  button(() => {
    field.value = "";
    field.dispatchEvent(new Event("input"));
  }, { class: "word", "data-t": "pad.clear" });
  button(() => addDigit("0"), { text: "0" });
  button(() => {
    field.value = field.value.slice(0, -1);
    field.dispatchEvent(new Event("input"));
  }, { text: "⌫", "data-t-label": "pad.delete" });
}

function showPress() {
  const ready = me !== null && field.value !== "";
  const press = byId("press");
  press.disabled = !ready;
  setText(press, !me ? t("who") : field.value ? t("press.at", { landmark: field.value }) : t("press.here"));
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
  setText(byId("voice"), t("press.done", { landmark }));
  showQueue();
}

function undo() {
  const undone = queue.undo();
  setText(byId("voice"), undone ? t("press.undone", { landmark: undone.landmark }) : t("press.late"));
  if (undone) {
    lastPress = null;
    setText(byId("last"), t("press.undone.at", { landmark: undone.landmark, time: timeOfDay(undone.unix_ms) }));
  }
  showQueue();
}

function showQueue() {
  const waiting = queue.waiting;
  const line = byId("queue");
  const live = connection.state === "live";
  setAttribute(line, "data-state", waiting ? "waiting" : queue.acknowledged ? "sent" : "empty");
  const held = queue.newest && queue.isHeld(queue.newest);
  let text;
  if (waiting) {
    text = t(live ? (held ? "queue.held" : "queue.sending") : "queue.offline", { count: waiting });
    if (sendTrouble) text += ` (${sendTrouble})`;
  } else {
    text = queue.acknowledged ? t("queue.received", { count: queue.acknowledged }) : t("queue.empty");
  }
  if (store.lasting === false && waiting) text += `. ${t("queue.lasting")}`;
  setText(line, text);
  const leftMs = held ? UNDO_MS - (Date.now() - queue.newest.unix_ms) : 0;
  byId("undo").hidden = !held;
  if (held) {
    setText(byId("undo"), t("press.undo", { landmark: queue.newest.landmark, seconds: Math.ceil(leftMs / 1000) }));
  }
  if (lastPress) setText(byId("last"), t("press.last", { landmark: lastPress.landmark, time: timeOfDay(lastPress.unix_ms) }));
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
    sharing.status = t("sent.failed", { error: error.message });
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
      showClock();
    }
  } catch {
    // Not connected after all; tried again with the next tick.
  } finally {
    comparing = false;
  }
}

function showClock() {
  const values = offset && { offset: number(Math.abs(offset.offsetMs)), within: number(offset.roundTripMs / 2) };
  setText(byId("clock-status"), t(!offset ? "clock.none" : offset.offsetMs < 0 ? "clock.behind" : "clock.ahead", values ?? {}));
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
  setHidden(byId("wearers-empty"), wearers.length > 0);
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
    if (wearer.taken && wearer.node !== me?.node) text.append(make("span", { class: "taken", "data-t": "who.taken" }));
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
  const name = byId("name").value.trim() || nodeName(chosen);
  rememberMe({ node: chosen, name, session: null });
  showPress();
  showMe();
  try {
    await postJson("/api/name", { node: chosen, name });
    rememberMe({ ...me, session: team.session?.started_unix_s ?? null });
    setText(byId("name-status"), t("who.done", { name, node: me.node }));
    open("landmarks");
  } catch (error) {
    setText(byId("name-status"), t("who.stored", { error: error.message }));
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
  setAttribute(byId("sound"), "data-state", siren.state);
  setText(byId("sound"), t(`sound.phone.${siren.state}`));
  setAttribute(byId("sound"), "aria-pressed", String(siren.state === "on"));
}

function showLock() {
  const button = byId("wake");
  setAttribute(button, "aria-pressed", String(lock.on));
  button.disabled = !lock.possible;
  setText(byId("wake-status"), !lock.possible
    ? t("wake.insecure")
    : lock.trouble || (lock.on ? t("wake.on") : ""));
}

function showCompass() {
  setAttribute(byId("compass"), "aria-pressed", String(sharing.on));
  setText(byId("compass"), t(sharing.on ? "compass.sharing" : "compass.share"));
  const status = byId("compass-status");
  if (sharing.status) setText(status, sharing.status);
  else if (sharing.on && sharing.newest) {
    const heading = number((450 - degrees(sharing.newest.heading_rad)) % 360);
    setText(status, t("compass.heading", { heading, sigma: number(degrees(sharing.newest.sigma_rad)), sent: sharing.sent }));
  } else {
    setText(status, CompassSharing.obstacle() || t("compass.hold"));
  }
}

hold(byId("mayday"), () => {
  if (!me) return open("me");
  // The phone's page may be closed, or its browser end, before the session has it.
  const call = { id: randomId(), node: me.node, by: me.name };
  store.setItem(MAYDAY, JSON.stringify({ ...call, unix_ms: Date.now() }));
  return callMayday(call);
});

/** Go on calling a MAYDAY that the session had not when the page was left. */
function resumeMayday() {
  try {
    const { unix_ms: calledMs, ...call } = JSON.parse(store.getItem(MAYDAY) ?? "{}");
    if (Math.abs(Date.now() - calledMs) < MAYDAY_KEPT_MS) callMayday(call);
  } catch {
    // Not ours.
  }
}

/** Called until the session has it: whoever calls may have no hand for a second time. */
async function callMayday(call) {
  clearTimeout(maydayTimer);
  if (store.getItem(MAYDAY) === null) return; // The board has it.
  if (byId("mayday-words").textContent === "") setText(byId("mayday-words"), t("mayday.sending"));
  try {
    await postJson("/api/mayday", { ...call, on: true });
    lastPress = null; // Else its line takes this one's place.
    setText(byId("last"), t("mayday.sent"));
    // The board may have come first, and have told its end as well; or tells its end alone.
    if (store.getItem(MAYDAY) !== null) {
      setText(byId("mayday-words"), t("mayday.sent"));
      maydayHad = true;
    }
    store.removeItem(MAYDAY);
  } catch (error) {
    if (store.getItem(MAYDAY) === null) return; // The board had it first.
    setText(byId("mayday-words"), t("mayday.failed", { error: error.message }));
    if (!error.again) store.removeItem(MAYDAY);
    else maydayTimer = setTimeout(() => callMayday(call), MAYDAY_AGAIN_MS);
  }
}
byId("marker-place").addEventListener("click", async () => {
  if (!me) return open("me");
  const sign = byId("marker-sign").value;
  try {
    await postJson("/api/marker", { action: "set", id: randomId(), sign, node: me.node, by: me.name });
    lastPress = null;
    return setText(byId("last"), t("marker.done", { sign: t(`marker.${sign}`) }));
  } catch (error) {
    lastPress = null;
    return setText(byId("last"), t("sent.failed", { error: error.message }));
  }
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
const showTheme = themeSwitch(byId("theme"), () => {
  showMe();
  showTeam();
});
setText(byId("last"), t("press.counts"));
open(page);
const showSettings = () => {
  showPress();
  showQueue();
  showSound();
  showLock();
  showCompass();
  showClock();
};
showSettings();
resumeMayday();
languageSwitch(byId("language"), () => {
  showTheme();
  showSettings();
  if (!lastPress) setText(byId("last"), t("press.counts"));
  banner.update(alarms);
  delete byId("orders").dataset.asked;
  if (orders) showOrders(orders);
  showTeam();
});
setInterval(() => {
  showQueue();
  compareClocks();
  sendPresses();
  sendHeadings();
  if (page === "me") fetchWearers();
}, 1000);
startBeat(beat);
connection.start();
