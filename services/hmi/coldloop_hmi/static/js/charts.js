// Charts over plant time: lines, bands, predictions, marks and the ribbon of modes, drawn with uPlot.
import { elements } from "./dom.js";
import { axisLabels, numberText, timeText } from "./numbers.js";
import { TEXTS } from "./quality.js";
import { scaleOf } from "./readout.js";

const { uPlot } = window;

/** @param {string} name */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

export const MODE_SHADE = {
  mpc: null,
  rest: "medium-ground",
  hold: "high-ground",
  classical: "low-ground",
  manual: "ahead",
};

const TITLE_HEIGHT = 16; // above the curves, never over them

/**
 * lines: [{label, stroke, stepped, width}], options: {title, unit, decimals, log, band, sync, axis, small}
 * @param {HTMLElement} holder
 * @param {ChartLine[]} lines
 * @param {ChartOptions} options
 */
export function makeChart(holder, lines, options) {
  const { onCursor, onPick, onZoom } = options;
  /** @type {Record<string, any>} what is drawn beside the curves */
  const extra = {
    doubtful: {},
    replaced: [],
    replacedEnds: [],
    band: null,
    predictions: [],
    planned: false,
    marks: [],
    modes: [],
    gaps: [],
    now: null,
  };
  const axis = (side) => ({
    stroke: colour("muted"),
    grid: { stroke: colour("line"), width: 0.5 },
    ticks: { stroke: colour("line"), width: 0.5, size: 4 },
    font: "11px system-ui, sans-serif",
    ...side,
  });
  const title = document.createElement("div");
  title.className = "title";
  title.append(
    ...(lines.length > 1 ? lines.flatMap((line) => [swatch(line), line.name || line.label]) : []),
    ` ${options.title}`,
  );
  holder.append(title);
  const size = () => ({ width: Math.max(80, holder.clientWidth), height: Math.max(40, holder.clientHeight) });
  const chart = new uPlot(
    {
      ...size(),
      padding: [TITLE_HEIGHT, options.small ? 14 : 28, options.axis ? 0 : 4, 0], // room for half of the last time
      legend: { show: false },
      cursor: {
        sync: options.sync ? { key: options.sync, setSeries: false } : undefined,
        drag: { x: Boolean(onZoom), y: false, setScale: false },
        points: { size: 5 },
        y: false,
      },
      scales: {
        x: { time: false, range: (_u, low, high) => (options.range ? options.range(low, high) : [low, high]) },
        y: options.log
          ? { distr: 3 }
          : {
              range: (_u, low, high) =>
                scaleOf(
                  Math.min(low ?? Infinity, ...extra.replacedEnds),
                  Math.max(high ?? -Infinity, ...extra.replacedEnds),
                  known(extra.band),
                  options.spread ?? 0,
                ),
            },
      },
      axes: [
        axis({
          show: Boolean(options.axis),
          size: options.small ? 20 : 24,
          values: (_u, ticks) => ticks.map((tick) => (tick < 0 ? "" : timeText(tick))),
          space: 90,
        }),
        axis({
          size: (_u, labels) =>
            Math.max(options.small ? 42 : 58, 14 + 6.5 * Math.max(0, ...(labels || []).map((label) => label.length))),
          space: 22,
          ...(options.log ? { filter: decades, grid: { stroke: colour("line"), width: 0.5, filter: decades } } : {}),
          values: (_u, ticks) =>
            options.log ? ticks.map((tick) => (tick === null ? "" : numberText(tick, 3))) : axisLabels(ticks),
        }),
      ],
      series: [
        {},
        ...lines.map((line) => ({
          label: line.label,
          stroke: () => colour(line.stroke),
          width: line.width || 1.4,
          points: { show: false },
          dash: line.dash,
          paths: line.stepped ? uPlot.paths.stepped({ align: 1 }) : undefined,
          spanGaps: false,
          pxAlign: 0, // not to whole pixels: a small step would be none
        })),
      ],
      hooks: {
        drawClear: [(u) => drawGround(u, extra)],
        draw: [
          (u) => {
            drawAhead(u, extra, lines);
            drawReplaced(u, extra);
            nameBand(u, extra);
          },
        ],
        setCursor: onCursor ? [onCursor] : [],
        setSelect: onZoom
          ? [
              (u) => {
                if (u.select.width > 4)
                  onZoom(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
                u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
              },
            ]
          : [],
      },
    },
    [[], ...lines.map(() => [])],
    holder,
  );
  if (onPick)
    chart.over.addEventListener("click", () => {
      if (chart.cursor.left >= 0) onPick(chart.posToVal(chart.cursor.left, "x"));
    });
  new ResizeObserver(() => chart.setSize(size())).observe(holder);
  return {
    chart,
    extra,
    lines,
    title: options.title,
    show(data, more = {}) {
      Object.assign(extra, more);
      chart.setData(withoutReplaced(data, lines, extra));
      Object.assign(holder.dataset, {
        doubtful: extra.replaced.length,
        gaps: extra.gaps.length,
        ahead: extra.planned && extra.predictions.length > 0,
      });
    },
  };
}

// What is not measured, or in doubt, is drawn differently.
function withoutReplaced([times, ...columns], lines, extra) {
  extra.replaced = [];
  extra.replacedEnds = [];
  return [
    times,
    ...columns.map((values, place) => {
      let shown = values;
      for (const [from, to, quality] of extra.doubtful[lines[place].label] || []) {
        const points = times
          .map((time, i) => [time, values[i], i])
          .filter(([time, value]) => time >= from && time < to && value !== null);
        if (shown === values) shown = [...values];
        for (const [, , i] of points) shown[i] = null;
        if (!points.length) continue;
        extra.replaced.push({ quality, points: [...points, [to, points.at(-1)[1]]] });
        for (const [, value] of points) extra.replacedEnds.push(value);
      }
      return shown;
    }),
  ];
}

function drawReplaced(u, extra) {
  if (!extra.replaced.length || u.scales.y.min === null) return;
  const { ctx, bbox } = u;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  ctx.strokeStyle = ctx.fillStyle = colour("muted");
  ctx.lineWidth = 1.4 * devicePixelRatio;
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  const size = 4 * devicePixelRatio;
  for (const { quality, points } of extra.replaced) {
    const places = points.map(([time, value]) => [u.valToPos(time, "x", true), u.valToPos(value, "y", true)]);
    ctx.setLineDash([2 * devicePixelRatio, 4 * devicePixelRatio]);
    ctx.beginPath();
    for (const [x, y] of places) ctx.lineTo(x, y); // the first one begins the line
    ctx.stroke();
    ctx.setLineDash([]);
    for (const [x, y] of [places[0], places.at(-1)]) {
      ctx.beginPath();
      ctx.moveTo(x - size, y - size);
      ctx.lineTo(x + size, y + size);
      ctx.moveTo(x - size, y + size);
      ctx.lineTo(x + size, y - size);
      ctx.stroke();
    }
    const left = Math.max(bbox.left, places[0][0]);
    if (places.at(-1)[0] - left > ctx.measureText(TEXTS[quality]).width + 4 * size)
      ctx.fillText(TEXTS[quality], left + 2 * size, places[0][1] - 1.5 * size);
  }
  ctx.restore();
}

function swatch(line) {
  const made = document.createElement("span");
  made.className = "swatch";
  made.style.borderColor = `var(--${line.stroke})`;
  if (line.dash) made.style.borderTopStyle = line.dash[0] > 2 ? "dashed" : "dotted";
  return made;
}

// Of a logarithmic axis only decades are shown, and of many decades as many as have room.
function decades(u, splits) {
  const powers = splits.map((value) => (value > 0 ? Math.log10(value) : NaN));
  const isDecade = (power) => Math.abs(power - Math.round(power)) < 1e-6;
  const every = Math.max(
    1,
    Math.ceil((14 * devicePixelRatio * powers.filter(isDecade).length) / (u.bbox.height || Infinity)),
  );
  return splits.map((value, i) => (isDecade(powers[i]) && Math.round(powers[i]) % every === 0 ? value : null));
}

// What is to be seen in a trend document, and nothing else: modes, gaps, substituted values, predictions, marks.
const MARKS = { load: "load", alarm: "alarm", operator: "command", fault: "sensor fault" };
/**
 * @param {Trend} found
 * @param {{predictions?: boolean, names?: string[]}} how
 * @returns {HTMLElement[]}
 */
export function legendOf(found, { predictions = false, names = Object.keys(found.series) } = {}) {
  const entry = (kind, text, shade) => {
    const made = document.createElement("span"),
      sample = document.createElement("i");
    made.className = "entry";
    sample.className = `sample ${kind}`;
    if (shade) sample.style.background = `var(--${shade})`;
    made.append(sample, text);
    return made;
  };
  const modes = [...new Set(found.modes.map((one) => one.mode))].filter((mode) => MODE_SHADE[mode]);
  const entries = modes.map((mode) => entry("ground", `mode ${mode}`, MODE_SHADE[mode]));
  if (found.gaps.length) entries.push(entry("gap", "nothing read"));
  const doubts = new Set(names.flatMap((name) => found.doubtful[name] || []).map(([, , quality]) => quality));
  for (const quality of doubts) entries.push(entry("dotted", TEXTS[quality]));
  if (predictions && found.planned && found.predictions.length)
    entries.push(entry("dashed", "expected from the newest sequence"));
  if (predictions && found.predictions.length > (found.planned ? 1 : 0))
    entries.push(entry("faint", "earlier predictions"));
  for (const kind of new Set(found.marks.map((mark) => mark.kind)))
    entries.push(entry(`mark ${kind}`, MARKS[kind] || kind));
  if (found.marks_since_s !== null)
    entries.push(entry("mark", `marks before ${timeText(found.marks_since_s)} are not shown`));
  return entries;
}

/**
 * The least range of a chart of a signal, from the ends of its bar.
 * @param {Ends} ends
 */
export const leastSpread = ([low, high]) => Math.min(1, (high - low) / 8);
const known = (band) => (band?.every(Number.isFinite) && band[1] > band[0] ? band : null);
// Of several curves in a chart each has a dash of its own: colour alone tells nobody in print.
export const DASHES = [undefined, [8, 3], [2, 2], [12, 3, 2, 3]];

function drawGround(u, extra) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.textAlign = "left";
  ctx.textBaseline = "alphabetic";
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  if (extra.band && extra.band[1] > extra.band[0] && u.scales.y.min !== null) {
    const top = u.valToPos(extra.band[1], "y", true),
      bottom = u.valToPos(extra.band[0], "y", true);
    ctx.fillStyle = colour("track");
    ctx.globalAlpha = 0.55;
    ctx.fillRect(bbox.left, top, bbox.width, bottom - top);
    ctx.globalAlpha = 1;
    ctx.strokeStyle = colour("muted");
    ctx.setLineDash([6, 4]);
    ctx.lineWidth = 1;
    for (const y of [top, bottom]) {
      ctx.beginPath();
      ctx.moveTo(bbox.left, y);
      ctx.lineTo(bbox.left + bbox.width, y);
      ctx.stroke();
    }
    ctx.setLineDash([]);
  }
  for (const [from, to] of extra.gaps) drawGap(u, from, to);
  for (const stretch of extra.modes) {
    const shade = MODE_SHADE[stretch.mode];
    if (!shade) continue;
    const from = u.valToPos(stretch.from, "x", true),
      to = u.valToPos(stretch.to, "x", true);
    ctx.globalAlpha = 0.28;
    ctx.fillStyle = colour(shade);
    ctx.fillRect(from, bbox.top, Math.max(1, to - from), bbox.height);
    if (extra.ribbon && to - from > 46) {
      ctx.globalAlpha = 1;
      ctx.fillStyle = colour("ink");
      ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
      ctx.fillText(stretch.mode, Math.max(from, bbox.left) + 4, bbox.top + bbox.height - 5);
    }
  }
  ctx.globalAlpha = 1;
  for (const mark of extra.marks) {
    const x = u.valToPos(mark.time, "x", true);
    const size = 5 * devicePixelRatio;
    ctx.fillStyle = ctx.strokeStyle = colour({ alarm: "high", fault: "critical" }[mark.kind] || "muted");
    ctx.lineWidth = 1;
    ctx.setLineDash([2, 4]);
    ctx.globalAlpha = 0.7;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
    ctx.globalAlpha = 1;
    ctx.beginPath();
    ctx.moveTo(x - size, bbox.top);
    ctx.lineTo(x + size, bbox.top);
    ctx.lineTo(x, bbox.top + 1.6 * size);
    ctx.fill();
  }
  ctx.setLineDash([]);
  if (extra.now !== null) {
    const x = u.valToPos(extra.now, "x", true);
    ctx.strokeStyle = colour("ink");
    ctx.lineWidth = 1;
    ctx.beginPath();
    ctx.moveTo(x, bbox.top);
    ctx.lineTo(x, bbox.top + bbox.height);
    ctx.stroke();
  }
  ctx.restore();
}

// What the band is called, and which of its edges are outside, over the curves.
function nameBand(u, extra) {
  const { band, bandName } = extra;
  if (!known(band) || u.scales.y.min === null) return;
  const { ctx, bbox } = u,
    size = devicePixelRatio,
    name = bandName || "band",
    bottom = bbox.top + bbox.height;
  const [low, high] = band.map((edge) => u.valToPos(edge, "y", true));
  ctx.save();
  ctx.font = `${10 * size}px system-ui, sans-serif`;
  ctx.textAlign = "right";
  const write = (text, y) => {
    const right = bbox.left + bbox.width - 4 * size,
      width = ctx.measureText(text).width;
    ctx.globalAlpha = 0.6;
    ctx.fillStyle = colour("panel");
    ctx.fillRect(right - width - 2 * size, y - 9 * size, width + 4 * size, 12 * size);
    ctx.globalAlpha = 1;
    ctx.fillStyle = colour("muted");
    ctx.fillText(text, right, y); // the curve is seen below it
  };
  if (high < bbox.top) write(`▲ ${name} to ${numberText(band[1], 7)}`, bbox.top + 11 * size);
  else if (bandName && low > bbox.top) write(name, high + 11 * size);
  if (low > bottom) write(`▼ ${name} from ${numberText(band[0], 7)}`, bottom - 4 * size);
  ctx.restore();
}

// Hatched: nothing was read.
function drawGap(u, start, end) {
  const { ctx, bbox } = u;
  const from = Math.max(bbox.left, u.valToPos(start, "x", true)),
    to = Math.min(bbox.left + bbox.width, u.valToPos(end, "x", true));
  if (to <= from) return;
  const step = 7 * devicePixelRatio,
    bottom = bbox.top + bbox.height;
  ctx.save();
  ctx.beginPath();
  ctx.rect(from, bbox.top, to - from, bbox.height);
  ctx.clip();
  ctx.strokeStyle = ctx.fillStyle = colour("muted");
  ctx.lineWidth = 1;
  ctx.globalAlpha = 0.7;
  ctx.setLineDash([]);
  ctx.beginPath();
  for (let x = from - bbox.height; x < to; x += step) {
    ctx.moveTo(x, bottom);
    ctx.lineTo(x + bbox.height, bbox.top);
  }
  ctx.stroke();
  ctx.globalAlpha = 1;
  ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
  const text = "nothing read",
    width = ctx.measureText(text).width;
  if (to - from > width + 12) {
    ctx.fillStyle = colour("panel");
    ctx.fillRect(from + 3, bottom - 17 * devicePixelRatio, width + 6, 15 * devicePixelRatio);
    ctx.fillStyle = colour("ink");
    ctx.fillText(text, from + 6, bottom - 6 * devicePixelRatio);
  }
  ctx.restore();
}

// A prediction that is not played, as in manual, says nothing of what is to come: it ends now.
function drawAhead(u, extra, lines) {
  if (!extra.predictions.length || u.scales.y.min === null) return;
  const { ctx, bbox } = u;
  const end = extra.planned || extra.now === null ? bbox.left + bbox.width : u.valToPos(extra.now, "x", true);
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, Math.max(0, end - bbox.left), bbox.height);
  ctx.clip();
  extra.predictions.forEach((prediction, place) => {
    const newest = extra.planned && place === extra.predictions.length - 1;
    ctx.lineWidth = (newest ? 1.8 : 1) * devicePixelRatio;
    ctx.globalAlpha = newest ? 1 : 0.4;
    ctx.setLineDash(newest ? [5, 4] : [2, 3]);
    prediction.curves.forEach((curve, line) => {
      ctx.strokeStyle = colour(newest ? lines[line].stroke : "ahead");
      ctx.beginPath();
      prediction.time.forEach((time, i) => {
        const x = u.valToPos(time, "x", true),
          y = u.valToPos(curve[i], "y", true);
        if (i) ctx.lineTo(x, y);
        else ctx.moveTo(x, y);
      });
      ctx.stroke();
    });
  });
  ctx.restore();
}

/**
 * Several holders of charts, one below the other, as one picture; below them what their signs mean.
 * @param {{chart: any, lines: ChartLine[], title: string}[]} charts
 * @param {PageElement} legend
 */
export function asPicture(charts, legend) {
  const canvases = charts.map((one) => one.chart.ctx.canvas);
  const picture = document.createElement("canvas");
  picture.width = Math.max(...canvases.map((one) => one.width));
  picture.height = canvases.reduce((sum, one) => sum + one.height + 18 * devicePixelRatio, 20 * devicePixelRatio);
  const ctx = /** @type {CanvasRenderingContext2D} */ (picture.getContext("2d"));
  ctx.fillStyle = colour("panel");
  ctx.fillRect(0, 0, picture.width, picture.height);
  let top = 0;
  charts.forEach((one, i) => {
    ctx.font = `${12 * devicePixelRatio}px system-ui, sans-serif`;
    let left = 8;
    for (const line of one.lines.length > 1 ? one.lines : []) {
      ctx.strokeStyle = colour(line.stroke);
      ctx.lineWidth = 2 * devicePixelRatio;
      ctx.setLineDash(line.dash || []);
      ctx.beginPath();
      ctx.moveTo(left, top + 9 * devicePixelRatio);
      ctx.lineTo(left + 16 * devicePixelRatio, top + 9 * devicePixelRatio);
      ctx.stroke();
      ctx.fillStyle = colour("ink");
      ctx.fillText(line.name || line.label, left + 20 * devicePixelRatio, top + 13 * devicePixelRatio);
      left += 32 * devicePixelRatio + ctx.measureText(line.name || line.label).width;
    }
    ctx.setLineDash([]);
    ctx.fillStyle = colour("ink");
    ctx.fillText(one.title, left, top + 13 * devicePixelRatio);
    ctx.drawImage(canvases[i], 0, top + 18 * devicePixelRatio);
    top += canvases[i].height + 18 * devicePixelRatio;
  });
  let left = 8;
  for (const entry of elements(".entry", legend)) {
    ctx.fillStyle = getComputedStyle(entry.querySelector("i")).backgroundColor;
    ctx.fillRect(left, top + 5 * devicePixelRatio, 14 * devicePixelRatio, 8 * devicePixelRatio);
    ctx.fillStyle = colour("ink");
    ctx.fillText(entry.textContent, left + 18 * devicePixelRatio, top + 13 * devicePixelRatio);
    left += ctx.measureText(entry.textContent).width + 34 * devicePixelRatio;
  }
  return picture;
}
