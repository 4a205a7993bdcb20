// The team's page: joins the modules.

import { isFresh, startBeat } from "./age.js";
import { Alarms } from "./alarms.js";
import { AlarmBanner, showNotices } from "./banner.js";
import { BoardView, hold } from "./board_view.js";
import { Connection } from "./connection.js";
import { DevicesDialog } from "./devices.js";
import { byId, followFocus, make, postJson, setAttribute, setText, storage } from "./dom.js";
import { Ground } from "./ground.js";
import { languageSwitch, said, t } from "./i18n.js";
import { FindView } from "./find_view.js";
import { Floors, nameFloors } from "./floors.js";
import { LinkBanner } from "./link_banner.js";
import { LogView, showUnseen } from "./log_view.js";
import { TeamMap } from "./map.js";
import { PeopleList } from "./people.js";
import { Siren } from "./sound.js";
import { SourceView } from "./source_view.js";
import { connectionWords, dataAgeS, replayWords, showConnection } from "./status_line.js";
import { alternativeWords, updateTable } from "./table_view.js";
import { Team } from "./team.js";
import { isDark, themeSwitch } from "./theme_switch.js";
import { Timeline } from "./timeline.js";
import { alarmText, duration, levelWords } from "./words.js";

const LIST_MS = 200; // five times a second is enough for the eye
const TROUBLE_MS = 60_000;
const TABLE_MS = 1000; // screen readers read the table

/** Who answers here, in the log and on the other pages. */
const by = () => t("commander");
const store = storage();
const team = new Team();
const alarms = new Alarms();
let listMs = 0;
let listTimer = null;
let tableMs = 0;
let trouble = null;
let troubleTimer = null;

const siren = new Siren(showSound);
const map = new TeamMap(byId("map"), team, { onPick: select, onCamera: showCamera });
map.floors = new Floors(team, () => {
  map.floors.update();
  map.invalidate();
}, (floor, name) => ground.post("floor", { floor, name }));
map.covers = [byId("map-tools"), byId("floors"), byId("section")];
const link = new LinkBanner(byId("link"), byId("alarm-voice"), linkChanged);
const banner = new AlarmBanner(byId("alarms"), { acknowledge, show: find });
const list = new PeopleList(byId("people"), { select, follow, find, shelve, mayday: (node) => board.mayday(node, true) });
const log = new LogView(byId("log"), { onNew: () => showUnseen(byId("show-log"), log.unseen) });
const findView = new FindView(byId("find"), {
  close: stopFinding,
  next: (by) => find(neighbour(findView.to, by, findView.from)),
  swap: () => startFinding(findView.to, findView.from),
});
const board = new BoardView(team, { by, find, say });
const ground = new Ground(map, team, { by, say });
const timeline = new Timeline(say);
byId("smoothed").addEventListener("change", (event) => {
  map.layers.smoothed = event.target.checked;
  map.invalidate();
});
const source = new SourceView();
const keepFocus = followFocus(byId("map"));
const connection = new Connection({ onMessage: handle, onState: () => refresh(true) });

/** Tell what went wrong here; after a while it is of the past. */
function say(text) {
  trouble = { level: "warning", text };
  clearTimeout(troubleTimer);
  troubleTimer = setTimeout(() => {
    trouble = null;
    refresh(true);
  }, TROUBLE_MS);
  refresh(true);
}

// -- messages --------------------------------------------------------------------------------------

function handle(message, ageS) {
  const kind = team.handle(message, ageS);
  if (kind === "hello") {
    trouble = null;
    alarms.clear();
    log.clear();
    timeline.clear();
    setText(byId("session"), team.session.emulated ? t("session.emulated", { name: team.session.name }) : team.session.name);
    link.setTitle(t(team.replayed ? "title.replay" : "title.live", { name: team.session.name ?? "" }));
    setAttribute(document.documentElement, "data-replay", team.replayed ? "true" : null);
    byId("end").hidden = team.replayed && !team.session.mission;
    source.show(Boolean(team.session.waiting));
    setAttribute(document.documentElement, "data-waiting", team.session.waiting ? "true" : null);
    if (team.session.waiting) {
      link.update(null);
      document.querySelectorAll("dialog[open]").forEach((dialog) => dialog.close());
    }
    showWayToLive(team.session.live_port);
    map.readTheme();
    showLegend();
    map.layer.forget();
  } else if (kind === "timeline") {
    timeline.handle(message);
  } else if (kind === "smoothed") {
    timeline.ready(team.smoothed.size > 0);
  } else if (kind === "board") {
    board.handle(message);
    ground.handle(message);
    nameFloors(message.floors);
  } else if (kind === "you") {
    setAttribute(document.documentElement, "data-role", message.role);
  } else if (kind === "log") {
    log.add(message.entries);
    if (byId("log-dialog").open) log.look(team);
  } else if (kind === "tracks") {
    map.layer.forget();
  } else if (kind === "picture") {
    takeAlarms();
    map.alarms = alarms.active;
    watchLink();
    timeline.show(team.timeS);
    findView.update(team);
  } else if (kind === "unknown") {
    trouble = { level: "warning", text: t("server.version") };
  }
  if (kind !== "ping") map.invalidate();
  refresh(kind === "hello");
}

function takeAlarms() {
  const { raised, cleared } = alarms.update(team.list());
  if (raised.length) setText(byId("alarm-voice"), raised.map((a) => `${levelWords(a.level)}: ${alarmText(a)}`).join(". "));
  if (cleared.length) {
    setText(byId("news-voice"), cleared
      .map((a) => t(a.kind === "lost" || a.kind === "post" ? "cleared.lost" : "cleared.still", { name: a.name })).join(". "));
  }
  if (team.replayed && raised.length) siren.sound(null);
  sound();
  banner.update(alarms);
}

function sound() {
  const kind = link.sounding ? "link" : alarms.sounding;
  siren.sound(kind && team.replayed ? "replay" : kind);
}

/** What was true a moment ago: all of it looks like it, and its age counts on. */
function linkChanged(lost) {
  map.old = lost;
  tableMs = -Infinity;
  map.readTheme();
  if (!lost) team.age(0);
  sound();
}

function watchLink() {
  link.update(team.lagS, team.unixS);
  if (link.lost) team.age(team.lagS);
}

function beat() {
  if (siren.state === "muted") showSound();
  watchLink();
  if (!link.lost) return showAge();
  alarms.update(team.list());
  banner.update(alarms);
  sound();
  findView.update(team, false);
  map.invalidate();
  return show();
}

// -- display ---------------------------------------------------------------------------------------

/** Bring the text up to date, now or within a fifth of a second. */
function refresh(now = false) {
  const wait = listMs + LIST_MS - performance.now();
  if (now || wait <= 0) {
    clearTimeout(listTimer);
    listTimer = null;
    show();
  } else if (listTimer === null) {
    listTimer = setTimeout(() => {
      listTimer = null;
      show();
    }, wait);
  }
}

function show() {
  listMs = performance.now();
  showAge();
  byId("waiting").hidden = team.order.length > 0;
  const notices = [...team.notices];
  if (trouble) notices.unshift(trouble);
  if (connection.unreadable) {
    notices.unshift({ level: "warning", text: t("server.unreadable", { count: connection.unreadable }) });
  }
  board.update();
  showUnseen(byId("show-log"), log.unseen);
  showNotices(byId("notices"), notices.map((notice) => ({ ...notice, text: team.withNames(said(notice.said, notice.text)) })));
  const heard = team.wearers().filter(isFresh).length;
  const all = team.wearers().length;
  byId("people").dataset.many = String(all > 8);
  setText(byId("count"), !all ? "" : heard === all ? `(${all})` : t("count.heard", { heard, all }));
  fillMe();
  list.update(team, {
    colourOf: (node) => map.colourOf(node),
    me: map.me,
    selected: map.selected,
    followed: map.camera.mode === "follow" ? map.camera.node : null,
    alarms,
  });
  map.floors.update();
  showCamera();
  const missing = team.list().filter((p) => p.status === "unlocated").map((p) => p.name);
  setText(byId("map-hint"), missing.length ? t("map.unlocated", { names: missing.join(", ") }) : "");
  if (performance.now() - tableMs > TABLE_MS) showTable();
  keepFocus();
}

function showTable() {
  tableMs = performance.now();
  setText(byId("map-words"), map.describe());
  if (byId("table-view").hidden) return;
  updateTable(byId("table").closest("table"), team, map.me);
  const from = team.person(map.me)?.name;
  setText(byId("from-title"), from ? t("table.from.name", { name: from }) : t("table.from.me"));
  setText(byId("table-caption"), map.describe());
  setText(byId("table-alternatives"), alternativeWords(team));
}

function age() {
  return team.arrivedUnixS === null ? null : dataAgeS({ unixS: team.unixS, arrivedUnixS: team.arrivedUnixS, receivedMs: team.viewedAt && 0, nowMs: 1000 * team.lagS });
}

function showAge() {
  const idle = team.session?.waiting && connection.state === "live";
  const status = idle ? { state: "connecting", words: t("source.title"), age: "" } : team.replayed ? replayWords(connection.state, team.session, team.timeS)
    : connectionWords(connection.state, age(), connection.retryS);
  showConnection(
    { line: byId("connection"), words: byId("connection-words"), age: byId("age"), retry: byId("retry") },
    status,
  );
}

function showCamera() {
  const { mode, node } = map.camera;
  setAttribute(byId("fit"), "aria-pressed", String(mode === "fit"));
  const follow = byId("follow");
  const name = team.person(mode === "follow" ? node : map.selected ?? map.me)?.name;
  setAttribute(follow, "aria-pressed", String(mode === "follow"));
  setText(follow, name ? t("follow.name", { name }) : t("follow"));
  follow.disabled = !name;
  const up = byId("heading-up");
  setAttribute(up, "aria-pressed", String(map.up === "heading"));
}

function showSound() {
  const button = byId("sound");
  setText(button, t(`sound.${siren.state}`, { time: duration(siren.mutedS) }));
  setAttribute(button, "data-state", siren.state);
  setAttribute(button, "aria-pressed", String(siren.state === "on"));
}

function fillMe() {
  const select = byId("me");
  const wanted = ["", ...team.list().map((p) => `${p.node} ${p.name}`)].join("\n");
  if (select.dataset.people !== wanted) {
    select.dataset.people = wanted;
    select.replaceChildren(make("option", { value: "", "data-t": "nobody" }),
      ...team.list().map((p) => make("option", { value: p.node, text: p.name })));
  }
  // Until a person is chosen, directions are relative to the first one.
  if (map.me === null && store.getItem("relpos.me") === null) map.me = team.wearers()[0]?.node ?? null;
  const value = map.me === null ? "" : String(map.me);
  if (select.value !== value) select.value = value;
}

// -- actions ---------------------------------------------------------------------------------------

function select(node) {
  map.selected = node === map.selected ? null : node;
  map.invalidate();
  refresh(true);
  if (node !== null) list.cards.get(node)?.element.scrollIntoView({ block: "nearest" });
}

function follow(node) {
  if (map.camera.mode === "follow" && map.camera.node === node) map.setCamera("fit");
  else map.setCamera("follow", node);
  refresh(true);
}

function setMe(node) {
  map.me = node;
  store.setItem("relpos.me", node === null ? "" : String(node));
  map.invalidate();
  refresh(true);
}

/** The next node by number after `node`, without `but`. */
function neighbour(node, by, but) {
  const others = team.wearers().map((p) => p.node).filter((n) => n !== but);
  const at = others.indexOf(node);
  return others[(at + by + others.length) % others.length] ?? node;
}

function find(node) {
  const seeker = findView.open && findView.from !== node ? findView.from : map.me;
  startFinding(seeker !== null && seeker !== node ? seeker : nearest(node), node);
}

/** The nearest person, who seeks where none is chosen. */
function nearest(node) {
  const near = team.wearers()
    .map((p) => p.node)
    .filter((n) => n !== node)
    .map((n) => [n, team.relation(n, node)?.distanceM ?? Infinity])
    .sort((a, b) => a[1] - b[1]);
  return near[0]?.[0] ?? node;
}

function startFinding(from, to) {
  map.find = { from, to };
  findView.start(from, to);
  findView.update(team, !link.lost);
  map.invalidate();
}

function stopFinding() {
  const { to } = findView;
  map.find = null;
  findView.stop();
  list.cards.get(to)?.findButton.focus();
  map.invalidate();
}

async function acknowledge(nodes) {
  const send = (node) => postJson("/api/acknowledge", { node, by: by() });
  const acknowledged = alarms.acknowledgeAll(nodes, by(), send, () => { sound(); banner.update(alarms); map.invalidate(); });
  // The button is gone: on to the next alarm's, or back to the map.
  (byId("alarms").querySelector(".rows .buttons button:last-child") ?? byId("map")).focus();
  try {
    await acknowledged;
  } catch (error) {
    say(t("acknowledge.failed", { error: error.message }));
  }
}

async function shelve(node, forS) {
  try {
    await postJson("/api/shelve", { node, seconds: forS, by: by() });
  } catch (error) {
    say(t("shelve.failed", { error: error.message }));
  }
}

// -- controls --------------------------------------------------------------------------------------

byId("zoom-in").addEventListener("click", () => map.zoom(1.4));
byId("zoom-out").addEventListener("click", () => map.zoom(1 / 1.4));
byId("fit").addEventListener("click", () => map.setCamera("fit"));
byId("follow").addEventListener("click", () => {
  if (map.camera.mode === "follow") map.setCamera("fit");
  else follow(map.selected ?? map.me);
});
byId("heading-up").addEventListener("click", () => map.setUp(map.up === "heading" ? "north" : "heading"));
byId("me").addEventListener("change", (event) => setMe(event.target.value ? Number(event.target.value) : null));
byId("retry").addEventListener("click", () => connection.wake());
for (const layer of ["tracks", "ranges"]) {
  const select = byId(layer);
  const value = store.getItem(`relpos.${layer}`);
  if ([...select.options].some((option) => option.value === value)) select.value = value;
  map.layers[layer] = select.value;
  select.addEventListener("change", () => {
    map.layers[layer] = select.value;
    store.setItem(`relpos.${layer}`, select.value);
    map.invalidate();
  });
}
byId("sound").addEventListener("click", () => {
  if (siren.state === "locked") siren.test();
  else siren.mute(!siren.muted);
});
byId("show-log").addEventListener("click", () => {
  byId("log-dialog").showModal();
  log.look(team);
});
byId("menu").addEventListener("click", () => {
  const open = byId("tools").classList.toggle("open");
  setAttribute(byId("menu"), "aria-expanded", String(open));
});
byId("sheet").addEventListener("click", () => {
  const open = byId("side").classList.toggle("open");
  setAttribute(byId("sheet"), "aria-expanded", String(open));
});
hold(byId("end"), async () => {
  try {
    await postJson("/api/end", { by: by() });
  } catch (error) {
    say(t("end.failed", { error: error.message }));
  }
});
byId("help").addEventListener("click", () => byId("help-dialog").showModal());
byId("as-table").addEventListener("click", () => {
  const view = byId("table-view");
  view.hidden = !view.hidden;
  setAttribute(byId("as-table"), "aria-pressed", String(!view.hidden));
  showTable();
});
/** The mission whose recording is played goes on beside it. */
function showWayToLive(port) {
  const link = byId("to-live");
  link.hidden = !port;
  if (port) link.href = `${location.protocol}//${location.hostname}:${port}/`;
}

function showLegend() {
  setText(byId("legend-alarms"), t("legend.alarms.is", { warning: team.limits.still_warning_s, alarm: team.limits.still_alarm_s }));
}

const showTheme = themeSwitch(byId("theme"), () => {
  map.readTheme(isDark());
  listMs = 0;
  refresh(true);
});

languageSwitch(byId("language"), () => {
  showTheme();
  showSound();
  showLegend();
  byId("notices").dataset.shown = "";
  banner.update(alarms);
  board.update();
  if (byId("log-dialog").open) log.look(team);
  map.invalidate();
  refresh(true);
});

const savedMe = store.getItem("relpos.me");
map.me = savedMe ? Number(savedMe) : null;
showSound();
new DevicesDialog();
startBeat(beat);
connection.start();
