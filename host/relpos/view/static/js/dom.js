// Small helpers around the document.

import { fill, said, t } from "./i18n.js";

export { storage } from "./storage.js";

/** The element of that id; it is an error of the page if there is none. */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element "${id}"`);
  return found;
}

/** Change a text only where it differs: twenty pictures a second must cost nothing. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

export function setAttribute(element, name, value) {
  if (value === null) {
    if (element.hasAttribute(name)) element.removeAttribute(name);
  } else if (element.getAttribute(name) !== String(value)) {
    element.setAttribute(name, String(value));
  }
}

export function setHidden(element, hidden) {
  if (element.hidden !== hidden) element.hidden = hidden;
}

/** An element with attributes ("class", "aria-label", ...; "text"; keys as in i18n.js) and children. */
export function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (name === "text") element.textContent = value;
    else if (value !== null && value !== undefined) element.setAttribute(name, value);
  }
  fill(element);
  element.append(...children);
  return element;
}

/** The server itself waits five seconds for the session. */
const ANSWER_MS = 8000;

const SVG = "http://www.w3.org/2000/svg";

// Shapes differ where colours do: a disc, a triangle, an octagon, as on signs.
const SHAPES = {
  unknown: "M1.5 1.5h17v17h-17z",
  starting: "M10 1.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17z",
  green: "M10 1.5a8.5 8.5 0 1 0 0 17 8.5 8.5 0 0 0 0-17z",
  yellow: "M10 1.5 19.5 18.5H.5z",
  red: "M6.3 1h7.4L19 6.3v7.4L13.7 19H6.3L1 13.7V6.3z",
};
const MARKS = {
  unknown: "M6 10h8",
  starting: "M10 5v5l3 3",
  green: "m5.6 10.3 3 3 5.8-6.3",
  yellow: "M10 7v5.2M10 15v.8",
  red: "m6.6 6.6 6.8 6.8m0-6.8-6.8 6.8",
};

/** A sign of health, hidden from screen readers: a word stands beside it. */
export function healthSign() {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "0 0 20 20");
  svg.setAttribute("aria-hidden", "true");
  const shape = document.createElementNS(SVG, "path");
  const mark = document.createElementNS(SVG, "path");
  mark.setAttribute("class", "mark");
  svg.append(shape, mark);
  return {
    element: svg,
    show(health) {
      setAttribute(svg, "class", `sign ${health}`);
      setAttribute(shape, "d", SHAPES[health] ?? SHAPES.yellow);
      setAttribute(mark, "d", MARKS[health] ?? MARKS.yellow);
    },
  };
}

/** An arrow that points up at 0 and turns by `relativeRad` counter-clockwise. */
export function arrow(className) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("viewBox", "-12 -12 24 24");
  svg.setAttribute("class", className);
  svg.setAttribute("aria-hidden", "true");
  const path = document.createElementNS(SVG, "path");
  svg.append(path);
  return {
    element: svg,
    point(relativeRad) {
      if (relativeRad === null || relativeRad === undefined) {
        setAttribute(path, "d", "M-6 0h12"); // no direction: a dash
        setAttribute(path, "transform", "rotate(0)");
        setAttribute(svg, "data-direction", "unknown");
        return;
      }
      setAttribute(path, "d", "M0-11 8 9 0 4.6-8 9z");
      setAttribute(path, "transform", `rotate(${((-relativeRad * 180) / Math.PI).toFixed(1)})`);
      setAttribute(svg, "data-direction", ((relativeRad * 180) / Math.PI).toFixed(1));
    },
  };
}

const FOCUSABLE = "button:not(:disabled), input:not(:disabled), select, summary, a[href], [tabindex='0']";

/**
 * Follow the focus; the function that is returned moves it on where its element has gone: to the
 * nearest one that is left, else to `fallback`.
 */
export function followFocus(fallback) {
  let path = [];
  document.addEventListener("focusin", (event) => {
    path = event.composedPath().filter((element) => element instanceof Element);
  });
  return () => {
    if (document.activeElement !== document.body || !path.length) return;
    if (path[0].isConnected && path[0].checkVisibility()) return;
    const near = path.slice(1).filter((element) => element.isConnected && !element.contains(fallback))
      .map((element) => [...element.querySelectorAll(FOCUSABLE)].find((one) => one.checkVisibility())).find(Boolean);
    (near ?? fallback).focus();
  };
}

/** Why a request was refused, in the page's language; undefined where the answer does not say. */
export async function refusal(answer) {
  const reply = await answer?.json().catch(() => null);
  return said(reply?.said, reply?.error);
}

/** Its errors say by `again` whether the same may succeed later. */
export async function postJson(address, body) {
  const answer = await fetch(address, {
    method: "POST",
    headers: { "content-type": "application/json" },
    body: JSON.stringify(body),
    // A network that swallows everything would be waited for, for minutes, without a word.
    signal: AbortSignal.timeout(ANSWER_MS),
  }).catch(() => {
    throw Object.assign(new Error(t("server.silent")), { again: true });
  });
  if (!answer.ok) {
    const again = answer.status === 429 || answer.status >= 500;
    throw Object.assign(new Error(await refusal(answer) ?? t("server.answered", { status: answer.status })), { again });
  }
  return answer.json();
}
