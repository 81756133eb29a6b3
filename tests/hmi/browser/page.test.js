// What the page decides in pure functions. That numbers are those of the figures is shown in tests/hmi/test_page_logic.py.
import assert from "node:assert/strict";
import test from "node:test";
import { stateText } from "../../../services/hmi/coldloop_hmi/static/js/alarms.js";
import {
  axisLabels,
  durationText,
  endsText,
  fixedText,
  numberText,
  secondsOf,
  timeText,
  UNKNOWN,
} from "../../../services/hmi/coldloop_hmi/static/js/numbers.js";
import { isListed, qualityIn, worse } from "../../../services/hmi/coldloop_hmi/static/js/quality.js";
import { onCurve, scaleOf, valuesAt } from "../../../services/hmi/coldloop_hmi/static/js/readout.js";
import {
  isStale,
  qualityOf,
  signalText,
  state,
  titleOf,
  valueText,
} from "../../../services/hmi/coldloop_hmi/static/js/store.js";

test("numbers have the digits that are asked for, and no sign of zero", () => {
  assert.deepEqual(
    [150000, 3.127e13, 1.4211e-14, -0.00012, -0, 12.3456].map((one) => numberText(one)),
    ["150000", "3.127e13", "1.421e-14", "-0.00012", "0", "12.35"],
  );
  assert.equal(numberText(Number.NaN), UNKNOWN);
  assert.deepEqual([fixedText(-0.001, 2), fixedText(1e9, 2), fixedText(Infinity, 1)], ["0.00", "1e9", UNKNOWN]);
});

test("labels of neighbouring marks differ", () => {
  assert.deepEqual(axisLabels([150000, 150000.5, 150001]), ["150000.0", "150000.5", "150001.0"]);
  assert.deepEqual(axisLabels([7]), ["7"]);
  assert.equal(new Set(axisLabels([1e12, 1e12 + 1, 1e12 + 2])).size, 3);
});

test("ends and times lose nothing that is seen", () => {
  assert.deepEqual(endsText(101300.5, 101475.25), ["101300.5", "101475.3"]);
  assert.deepEqual([59.999, -61, Number.NaN].map(timeText), ["0:01:00", "-0:01:01", UNKNOWN]);
  assert.deepEqual(["1:02:03.5", "2:03", " "].map(secondsOf), [3723.5, 123, null]);
  assert.ok(Number.isNaN(secondsOf("1:x")) && Number.isNaN(secondsOf("-5")));
  assert.deepEqual([900, 7200, 90, 0.5].map(durationText), ["15 min", "2 h", "90 s", "0.5 s"]);
});

test("the worst quality of a name and of its beginnings counts", () => {
  /** @type {Record<string, Quality>} */
  const entries = { "a.": "stale", "a.y.T3": "suspect", "b.y.T3": "held" };
  assert.deepEqual(
    ["a.y.T3", "b.y.T3", "b.y.T31"].map((one) => qualityIn(entries, one)),
    ["stale", "held", "good"],
  );
  assert.equal(worse("held", "bad"), "bad");
  assert.ok(isListed(["plant."], "plant.pace.factor") && !isListed(["plant.pace"], "plant.pace.factor"));
});

/** @type {any} */
const TREND = {
  now_s: 20,
  planned: true,
  time: [0, 5, 5.25, 10, 20],
  series: { L1: [1, 2, null, 3, 4], v: [5, 5, null, 5, 5] },
  doubtful: { L1: [[10, 15, "suspect"]] },
  bands: { L1: [0, 9] },
  updates: { time: [0, 4, 4.25], tau_u: [2, 2, null], q: [1, 1, null] },
  predictions: [{ time: [20, 30], L1: [4, 6], input_time: [20, 25, 30], v: [5, 7, 9] }],
};

test("the cursor shows what was measured, and after it what is predicted", () => {
  const at = (/** @type {number} */ time) => valuesAt(TREND, time).map((one) => [one.name, one.value, one.quality]);
  assert.deepEqual(at(12), [
    ["L1", 3, "suspect"],
    ["v", 5, "good"],
  ]);
  assert.deepEqual(at(7), []);
  assert.deepEqual(at(26), [
    ["L1", 5.2, "predicted"],
    ["v", 7, "predicted"],
  ]);
  assert.deepEqual(valuesAt({ ...TREND, planned: false }, 26), []);
  assert.equal(onCurve([0, 10], [0, 1], 11, false), null);
});

test("a scale follows the data and leaves a far band outside", () => {
  const near = (/** @type {number[]} */ ends, /** @type {number[]} */ wanted) =>
    ends.every((end, i) => Math.abs(end - wanted[i]) < 1e-9);
  assert.ok(near(scaleOf(42, 44, [20, 60], 0.1), [41.84, 44.16]));
  assert.ok(near(scaleOf(null, null, [59, 61], 0.1), [58.84, 61.16]));
  assert.ok(near(scaleOf(null, null, null, 0.1), [-0.08, 1.08]));
});

test("the title says what an operator of another tab has to know", () => {
  /** @type {any[]} */
  const alarms = [
    { active: true, state: "unacknowledged" },
    { active: false, state: "returned" },
  ];
  assert.equal(titleOf({ alarms, stale: false, mode: "HOLD" }), "1 alarm · HOLD · Coldloop");
  assert.equal(titleOf({ alarms: [], stale: true, mode: "HOLD" }), "NOT CURRENT · Coldloop");
  assert.equal(titleOf({ alarms: [], stale: false, mode: "MPC" }), "Coldloop");
});

test("an alarm's state is told in words", () => {
  const texts = { returned: "returned unacknowledged" };
  const shelved = { state: "shelved", active: true, shelved_until_s: 3600 };
  assert.equal(stateText(shelved, texts), "shelved, active until 1:00:00");
  assert.equal(stateText({ state: "returned", active: false }, texts), "returned unacknowledged");
});

test("a value is written with the unit, the words or the time of its signal", () => {
  /** @type {any} */
  const about = { words: {}, unit: "K", decimals: 2, digits: 0, counts: "" };
  const words = { ...about, words: { 1: "mpc" }, unit: "" };
  const ticks = { ...about, unit: "", decimals: null, counts: "time" };
  state.catalog = /** @type {any} */ ({ tick_s: 0.25, signals: { T5: about, mode: words, tick: ticks } });
  state.values = { T5: 8.456, mode: 1, tick: 240 };
  assert.deepEqual(
    [valueText("T5"), valueText("mode", "mode"), valueText("tick"), valueText("tick", "ticks"), valueText("none")],
    ["8.46 K", "MPC", "0:01:00 (tick 240)", "60.00 s", "–"],
  );
  assert.equal(signalText("text", about), "text");
});

test("nothing is current where the page itself is silent", () => {
  state.heard = performance.now();
  state.stale = ["plant."];
  assert.deepEqual([isStale("plant.pace"), isStale("control_plc.status"), qualityOf("x")], [true, false, "good"]);
  state.heard = performance.now() - 10_000;
  assert.deepEqual([isStale("control_plc.status"), qualityOf("x")], [true, "stale"]);
});
