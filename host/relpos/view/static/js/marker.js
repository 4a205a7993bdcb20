// What stands for somebody on the map and in the section: a disc, a square for the command post.

import { t } from "./i18n.js";

/** The outline as the current path; `radius` is the disc's. */
export function pathMarker(context, person, x, y, radius) {
  context.beginPath();
  if (person.post) context.rect(x - 0.9 * radius, y - 0.9 * radius, 1.8 * radius, 1.8 * radius);
  else context.arc(x, y, radius, 0, 2 * Math.PI);
}

/** What is written in it: the node's number, or the letters of the command post. */
export const signOf = (person) => (person.post ? t("post.short") : String(person.node));
