// What the page's modules share with its server: the stream, the catalogue, and the elements that it looks up by id.

/** An element of the page: some ids are fields, buttons, dialogs, links or frames. */
interface PageElement extends HTMLElement {
  value: any;
  disabled: boolean;
  open: boolean;
  min: any;
  max: any;
  href: string;
  hash: string;
  files: FileList;
  contentWindow: Window;
  onclose: () => void;
  showModal(): void;
  close(): void;
  setCustomValidity(text: string): void;
  querySelector(selector: string): any;
  readonly dataset: any;
  readonly children: HTMLCollectionOf<any>;
}

interface Window {
  uPlot: any;
}

type Quality = "good" | "suspect" | "held" | "bad" | "stale" | "simulated";
type Ends = [number, number];

/** A register that the page shows (`coldloop_hmi/documents.py`). */
interface SignalAbout {
  service: string;
  block: string;
  label: string;
  description: string;
  address: number;
  writer: string;
  unit: string;
  decimals: number | null;
  digits: number;
  counts: string;
  words: Record<string, string>;
}

interface ProcessSignal {
  name: string;
  unit: string;
  label: string;
  register: string;
  bar: Ends;
  bounds: Ends;
  loop: string;
  dead_band: number;
}

interface ProcessLoad {
  word: string;
  unit: string;
  bar: Ends;
  span: Ends;
}

/** What does not change while the page's server runs. */
interface Catalog {
  tick_s: number;
  services: string[];
  signals: Record<string, SignalAbout>;
  outputs: string[];
  trended: string[];
  training: boolean;
  replay: boolean;
  alarm_actions: Record<string, number>;
  alarm_states: Record<string, string>;
  process: {
    sample_s: number;
    mimic: string;
    inputs: ProcessSignal[];
    controlled: ProcessSignal[];
    measured: ProcessSignal[];
    disturbances: ProcessSignal[];
    load: ProcessLoad | null;
  };
}

interface Alarm {
  number: number;
  name: string;
  state: string;
  active: boolean;
  cause: string;
  priority: number;
  priority_word: string;
  times: number;
  raised_s: number;
  shelved_until_s: number;
}

interface PlantNote {
  kind: string;
  mode?: string;
  alarms?: string[];
  bands?: Record<string, (number | null)[]>;
}

interface ReplayState {
  name: string;
  playing: boolean;
  last_tick: number;
}

/** What the stream has said last. */
interface PageState {
  catalog: Catalog;
  me: { user: string; role: string; operates: boolean; can_log_in: boolean };
  values: Record<string, any>;
  services: Record<string, { live: boolean; age_s: number | null; reason: string }>;
  stale: string[];
  quality: Record<string, Quality>;
  commands: number;
  alarms: Alarm[];
  update: any;
  replay?: ReplayState;
  plant: PlantNote;
  deviation: string;
  tick: number;
  heard: number;
  refused: string;
}

/** What has changed; `names` is null where all has. */
interface Change {
  names: Set<string> | null;
  alarms: boolean;
  update: boolean;
}

/** A window of plant time, as `api/trend` answers. */
interface Trend {
  now_s: number;
  planned: boolean;
  time: number[];
  series: Record<string, (number | null)[]>;
  updates: Record<string, (number | null)[]> & { time: number[] };
  doubtful: Record<string, [number, number, Quality][]>;
  bands: Record<string, Ends>;
  bounds: Record<string, Ends>;
  predictions: any[];
  marks: { kind: string; time: number }[];
  marks_since_s: number | null;
  modes: { mode: string; from: number; to: number }[];
  gaps: Ends[];
}

/** A curve of a chart. */
interface ChartLine {
  label: string;
  stroke: string;
  name?: string;
  width?: number;
  dash?: number[];
  stepped?: boolean;
  from?: string;
}

/** How a chart is drawn; times are in seconds. */
interface ChartOptions {
  title: string;
  spread?: number;
  log?: boolean;
  axis?: boolean;
  small?: boolean;
  sync?: string;
  range?: (low: number, high: number) => Ends;
  onZoom?: (from: number, to: number) => void;
  onCursor?: (u: any) => void;
  onPick?: ((time: number) => void) | null;
}

declare module "node:test";
declare module "node:assert/strict";
