// What a trend has at a time: values that were measured, and after the newest one what is predicted, named so.
const before = (times, time) => {
  let low = 0,
    high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time) low = middle + 1;
    else high = middle;
  }
  return low - 1;
};

/**
 * A curve between its instants: a straight line, or for inputs the value of the instant before; null outside.
 * @param {number[]} times
 * @param {number[]} values
 * @param {number} time
 * @param {boolean} isStepped
 */
export function onCurve(times, values, time, isStepped) {
  const i = before(times, time);
  if (i < 0 || time > times[times.length - 1]) return null;
  if (isStepped || i === times.length - 1) return values[i];
  return values[i] + ((values[i + 1] - values[i]) * (time - times[i])) / (times[i + 1] - times[i]);
}

/**
 * What is known at a time; the quality of what is still to come is "predicted".
 * @param {Trend} trend
 * @param {number} time
 * @returns {{name: string, value: any, quality: string}[]}
 */
export function valuesAt(trend, time) {
  if (time > trend.now_s) {
    const newest = trend.planned ? trend.predictions.at(-1) : null;
    return !newest
      ? []
      : Object.keys(trend.series)
          .filter((name) => name in newest)
          .map((name) => {
            const isInput = newest[name].length === newest.input_time.length && !(name in trend.bands);
            return {
              name,
              value: onCurve(isInput ? newest.input_time : newest.time, newest[name], time, isInput),
              quality: "predicted",
            };
          })
          .filter((one) => one.value !== null);
  }
  const doubt = (name) =>
    ((trend.doubtful[name] || []).find(([from, to]) => from <= time && time < to) || [])[2] || "good";
  const at = (times, values) => {
    const i = before(times, time);
    return i < 0 ? null : values[i];
  };
  const measured = Object.entries(trend.series).map(([name, values]) => ({
    name,
    value: at(trend.time, values),
    quality: doubt(name),
  }));
  const ofUpdate = ["tau_u", "q"].map((name) => ({
    name,
    value: at(trend.updates.time, trend.updates[name]),
    quality: "good",
  }));
  return [...measured, ...ofUpdate].filter((one) => one.value !== null && one.value !== undefined);
}

/**
 * The scale of a chart: that of the data, at least `least` wide, and those ends of a band that are not far from them.
 * @param {number | null} low
 * @param {number | null} high
 * @param {Ends | null} band
 * @param {number} least
 * @returns {Ends}
 */
export function scaleOf(low, high, band, least) {
  const isKnown = low !== null && high !== null && Number.isFinite(low) && Number.isFinite(high);
  let [from, to] = isKnown ? [low, high] : band ? band : [0, 1];
  const missing = least - (to - from);
  if (missing > 0) {
    from -= missing / 2;
    to += missing / 2;
  }
  const span = to - from,
    near = (band || []).filter((end) => end > from - span && end < to + span);
  [from, to] = [Math.min(from, ...near), Math.max(to, ...near)];
  return [from - (to - from) * 0.08, to + (to - from) * 0.08];
}
