// Numbers and times as people read them: the one place where digits are chosen, as `coldloop/number_text.py` does.
export const UNKNOWN = "–";
const FIRST_PLAIN = -4,
  LAST_PLAIN = 6,
  LONGEST_FRACTION = 7,
  NEAR = 1e-3,
  LARGE = 1e9;

const unsignedZero = (text) => (Number(text) === 0 ? text.replace(/^-/, "") : text);
const trimmed = (text) => unsignedZero(text.includes(".") ? text.replace(/\.?0+$/, "") : text);

/**
 * A number with so many significant digits, no digit before the point rounded off; a dash where it is not known.
 * @param {number} value
 * @param {number} digits
 */
export function numberText(value, digits = 4) {
  if (!Number.isFinite(value)) return UNKNOWN;
  const [mantissa, power] = value.toExponential(digits - 1).split("e"),
    exponent = Number(power);
  if (Number(mantissa) === 0) return "0";
  if (exponent >= FIRST_PLAIN && exponent <= LAST_PLAIN)
    return trimmed(value.toFixed(Math.max(0, digits - 1 - exponent)));
  return `${trimmed(mantissa)}e${exponent}`;
}

/**
 * A number with the digits after the point that its signal has.
 * @param {number} value
 * @param {number} decimals
 */
export function fixedText(value, decimals) {
  if (!Number.isFinite(value)) return UNKNOWN;
  return Math.abs(value) < LARGE ? unsignedZero(value.toFixed(decimals)) : numberText(value, 7);
}

/**
 * Labels of the marks of a linear axis: as many digits as their step needs, so that neighbours differ.
 * @param {number[]} marks
 */
export function axisLabels(marks) {
  const known = [...new Set(marks.filter(Number.isFinite))].sort((one, other) => one - other);
  const step = Math.min(...known.slice(1).map((mark, i) => mark - known[i]));
  if (known.length < 2) return marks.map((mark) => numberText(mark, 7));
  const fits = (text) => known.every((mark) => Math.abs(Number(text(mark)) - mark) <= NEAR * step);
  if (Math.max(...known.map(Math.abs)) < 10 ** (LAST_PLAIN + 1)) {
    for (let places = 0; places <= LONGEST_FRACTION; places += 1)
      if (fits((mark) => mark.toFixed(places))) return marks.map((mark) => fixedText(mark, places));
  }
  let digits = 1;
  while (digits < 17 && !fits((mark) => mark.toExponential(digits - 1))) digits += 1;
  return marks.map((mark) => numberText(mark, digits));
}

/**
 * Both ends of a scale, with four digits of what lies between them.
 * @param {number} low
 * @param {number} high
 */
export function endsText(low, high) {
  const places = Math.max(0, 3 - Math.floor(Math.log10(high - low || 1)));
  return [low, high].map((end) =>
    Math.abs(end) < LARGE && places <= LONGEST_FRACTION ? trimmed(end.toFixed(places)) : numberText(end, 7),
  );
}

/** @param {number} seconds */
export function timeText(seconds) {
  if (!Number.isFinite(seconds)) return UNKNOWN;
  const sign = seconds < 0 ? "-" : "",
    all = Math.round(100 * Math.abs(seconds)) / 100;
  const hours = Math.floor(all / 3600),
    minutes = Math.floor(all / 60) % 60,
    rest = all % 60;
  const pad = (number) => String(number).padStart(2, "0");
  const tail = Number.isInteger(all) ? pad(rest) : rest.toFixed(2).padStart(5, "0");
  return `${sign}${hours}:${pad(minutes)}:${tail}`;
}

/**
 * The time in a text such as "1:02:03", "2:03" or "3"; null where there is none, NaN where it is no time.
 * @param {string} text
 */
export function secondsOf(text) {
  if (!text.trim()) return null;
  return text
    .trim()
    .split(":")
    .reduce((sum, part) => (/^\d+(\.\d+)?$/.test(part) ? 60 * sum + Number(part) : NaN), 0);
}

/**
 * A length of time such as "15 min", in the largest unit that it is a whole number of.
 * @param {number} seconds
 */
export function durationText(seconds) {
  /** @type {[string, number][]} */
  const units = [
    ["h", 3600],
    ["min", 60],
    ["s", 1],
  ];
  const [unit, length] = units.find((one) => seconds % one[1] === 0) || ["s", 1];
  return `${numberText(seconds / length)} ${unit}`;
}
