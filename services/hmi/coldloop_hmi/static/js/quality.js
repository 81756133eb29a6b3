// The quality of a value: one word, the worst that applies, as `coldloop_hmi/process_image.py` has it; and how it is shown.
/** @type {Quality[]} */
export const QUALITIES = ["good", "suspect", "held", "bad", "stale", "simulated"]; // the worst last
/** @type {Record<string, string>} */
export const LETTERS = { good: "", suspect: "?", held: "H", bad: "B", stale: "", simulated: "S" };
/** @type {Record<string, string>} */
export const TEXTS = {
  suspect: "suspect: the optimiser does without it",
  held: "sensor bad: last good value",
  bad: "sensor bad",
  stale: "not current",
  simulated: "simulated: not measured, or a fault put in for training",
};

const concerns = (entry, name) => name === entry || (entry.endsWith(".") && name.startsWith(entry));
/** @type {(one: Quality, other: Quality) => Quality} */
export const worse = (one, other) => (QUALITIES.indexOf(one) > QUALITIES.indexOf(other) ? one : other);

/**
 * The quality of a signal; entries are names, or with a dot at the end beginnings of names.
 * @param {Record<string, Quality>} entries
 * @param {string} name
 * @returns {Quality}
 */
export function qualityIn(entries, name) {
  return Object.entries(entries).reduce(
    (worst, [entry, quality]) => (concerns(entry, name) ? worse(worst, quality) : worst),
    /** @type {Quality} */ ("good"),
  );
}
/** @type {(names: string[], name: string) => boolean} */
export const isListed = (names, name) => names.some((entry) => concerns(entry, name));
