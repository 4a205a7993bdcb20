// The pages' language: the messages of one catalogue, numbers and times by Intl.
//
// English is always loaded: a message that a catalogue lacks, and a text of the session without a
// key, is English.

import { storage } from "./storage.js";

export const LANGUAGES = ["en", "de", "fr", "es"];
const KEPT = "relpos.language";
const store = storage();
const catalogues = {};
const formats = new Map();
let language = "en";

async function load(wanted) {
  if (catalogues[wanted]) return;
  // Missing while there is no connection: then English stays.
  const answer = await fetch(new URL(`../lang/${wanted}.json`, import.meta.url)).catch(() => null);
  if (answer?.ok) catalogues[wanted] = await answer.json();
}

/** The language that was chosen here, else the first of the browser's that there is. */
function preferred() {
  const wanted = [store.getItem(KEPT), ...(navigator.languages ?? [])].filter(Boolean);
  return wanted.map((tag) => tag.toLowerCase().split("-")[0]).find((tag) => LANGUAGES.includes(tag)) ?? "en";
}

/** The browser's own variant of the language: the order of a date differs within English. */
function locale() {
  return (navigator.languages ?? []).find((tag) => tag.toLowerCase().split("-")[0] === language) ?? language;
}

function format(Kind, options) {
  const key = `${Kind.name} ${JSON.stringify(options)}`;
  if (!formats.has(key)) formats.set(key, new Kind(locale(), options));
  return formats.get(key);
}

/** A number with so many decimals, without groups of thousands. */
export function number(value, decimals = 0) {
  return format(Intl.NumberFormat, { minimumFractionDigits: decimals, maximumFractionDigits: decimals, useGrouping: false })
    .format(value);
}

/** Time of day, "14:03:22". */
export function timeOfDay(unixMs) {
  return format(Intl.DateTimeFormat, { hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23" }).format(unixMs);
}

export function date(unixMs) {
  return format(Intl.DateTimeFormat, { dateStyle: "short" }).format(unixMs);
}

/** Whether there is such a message, in English at least. */
export function has(key) {
  return key in (catalogues.en ?? {});
}

/** The message `key` with its `{values}`; one with forms ("one", "other") goes by `values.count`. */
export function t(key, values = {}) {
  let message = catalogues[language]?.[key] ?? catalogues.en?.[key] ?? key;
  if (typeof message === "object") message = message[format(Intl.PluralRules, {}).select(values.count)] ?? message.other;
  return message.replace(/\{(\w+)\}/g, (_, name) => {
    const value = values[name] ?? "";
    // A text within a text.
    if (typeof value === "object") return said(value, "");
    return typeof value === "number" ? format(Intl.NumberFormat, { maximumFractionDigits: 2, useGrouping: false }).format(value) : String(value);
  });
}

/** A text of the session: by its key where it has one that this page knows, else as it is. */
export function said(said, text) {
  return said && has(`said.${said.key}`) ? t(`said.${said.key}`, said.values) : text;
}

const PLACES = {
  "data-t-label": "aria-label", "data-t-placeholder": "placeholder", "data-t-alt": "alt", "data-t-role": "aria-roledescription", "data-t-title": "title",
};

const KEYED = ["data-t", ...Object.keys(PLACES)].map((name) => `[${name}]`).join();

/** Fill an element that carries a key: `data-t` is its text, the others are its attributes. */
export function fill(element) {
  const key = element.getAttribute("data-t");
  if (key) element.textContent = t(key);
  for (const [from, to] of Object.entries(PLACES)) {
    if (element.hasAttribute(from)) element.setAttribute(to, t(element.getAttribute(from)));
  }
}

async function use(wanted) {
  await Promise.all([load("en"), load(wanted)]);
  language = catalogues[wanted] ? wanted : "en";
  formats.clear();
  document.documentElement.lang = language;
  for (const element of document.querySelectorAll(KEYED)) fill(element);
}

/** The language that is shown. */
export function current() {
  return language;
}

/** Fill a selection with the languages, each by its own name; `changed` is called after a change. */
export function languageSwitch(select, changed) {
  select.replaceChildren(...LANGUAGES.map((code) => {
    const option = document.createElement("option");
    option.value = option.lang = code;
    option.textContent = new Intl.DisplayNames([code], { type: "language" }).of(code);
    return option;
  }));
  select.value = language;
  select.addEventListener("change", async () => {
    store.setItem(KEPT, select.value);
    await use(select.value);
    select.value = language;
    changed();
  });
}

await use(preferred());
