// Accepting all that is predicted better than a limit: a slider, and a button that says how many changes that are and what stays.

import { DEFAULT_LIMIT_MM, LIMITS_MM, divideByLimit } from "./events.js";

const find = (id) => document.getElementById(id);
const listOpen = (events) => events.flatMap((each) => each.changes).filter((each) => !each.is_reviewed);
const plural = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;

export class LimitBar {
  constructor({ getEvents, getTake, onAccept }) {
    Object.assign(this, { getEvents, getTake, onAccept });
    const stored = LIMITS_MM.indexOf(Number(localStorage.getItem("limit-mm")));
    Object.assign(find("limit"), { max: LIMITS_MM.length - 1, value: stored < 0 ? LIMITS_MM.indexOf(DEFAULT_LIMIT_MM) : stored });
    find("limit").addEventListener("input", () => this.change(0));
    find("limit").addEventListener("pointerup", () => find("limit").blur());
  }

  get limitMm() { return LIMITS_MM[Number(find("limit").value)]; }

  // Moves the limit by some steps.
  change(steps) {
    find("limit").value = Number(find("limit").value) + steps;
    localStorage.setItem("limit-mm", this.limitMm);
    this.render();
  }

  // Accepts the changes of the listed events within the limit, those that are not reviewed.
  accept() {
    const changes = listOpen(divideByLimit(this.getEvents(), this.limitMm).within);
    if (changes.length) this.onAccept(changes);
  }

  render() {
    const events = this.getEvents(), isFiltered = events.flatMap((each) => each.changes).length < this.getTake().changes.length;
    const { within, above } = divideByLimit(events, this.limitMm), unpredicted = above.filter((each) => each.limit_mm === Infinity).length;
    const button = find("accept-within");
    find("limit-value").textContent = `${this.limitMm} mm`;
    find("limit").setAttribute("aria-valuetext", `${this.limitMm} mm`);
    button.firstChild.textContent = `Accept ${plural(listOpen(within).length, "change")} `;
    button.disabled = !within.length;
    const stays = above.length ? `${plural(above.length, "event")} (${plural(listOpen(above).length, "change")})` : "nothing";
    find("limit-text").textContent = `${plural(within.length, "event")} within it; ${stays}${isFiltered ? " of those listed" : ""} to look at`
      + (unpredicted ? `, ${unpredicted} without a prediction.` : ".");
  }
}
