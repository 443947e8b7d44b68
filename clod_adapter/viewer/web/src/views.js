// Changes of the view by controls and links, what plays, and pictures and videos of it.
import * as camera from "./camera.js";
import { elements, state, ui, viewer } from "./page.js";
import * as stage from "./stage.js";
import { add, cross, dot, unit } from "./vector.js";

const TURN = 20; // seconds of the turntable's turn
const SPEED = 0.6; // of the path: radians, or distances to the pivot, a second
const STOPS = 40; // photographs of a path; of more, every second one or fewer is taken
const FPS = 30, BITS = 16e6; // of a video, per second
const TYPES = ["video/mp4;codecs=avc1.640028", "video/webm;codecs=vp9", "video/webm"];
export const videoType = TYPES.find((type) => window.MediaRecorder?.isTypeSupported(type));

const view = camera.camera;
let running = null; // what the present animation does at a time, seconds; it returns whether it goes on

/** An axis as three numbers; for "", the mean up vector of the photographs' cameras, else that of the scene. */
function axisOf(value) {
  const sum = viewer.photographs.reduce((total, { viewmat }) => add(total, viewmat[1].slice(0, 3), -1), [0, 0, 0]);
  return value ? value.split(",").map(Number) : Math.hypot(...sum) > 1e-3 ? unit(sum) : stage.model.extent.up;
}

/** Selects the camera of the present view in the list; null for none. */
export function select(number) {
  if (number !== null) viewer.cameraNumber = number;
  elements.camera.selectedIndex = number ?? viewer.cameras.length;
}

/** Ends what plays, and shows what `set()` makes of the view. */
function show(number, set) {
  stop();
  set();
  select(number);
  ui.changed();
}

export const reset = () => show(0, () => camera.fit(stage.model.extent, viewer.cameras, axisOf(viewer.up)));
export const goTo = (number) => show(number, () => camera.setCamera(viewer.cameras[number]));

/** Goes to the next camera, or the one before. */
export function goBy(step) {
  const { length } = viewer.cameras;
  if (length) goTo((viewer.cameraNumber + step + length) % length);
}

/** `value`: "x,y,z" of an axis; "" for that of the cameras or the scene. */
export function setUp(value) {
  viewer.up = value;
  show(null, () => camera.setUp(axisOf(value)));
}

function moved() {
  stage.change(true);
  ui.forget();
}

export function movedByHand() {
  stop();
  select(null);
  moved();
}

/** Copies a link with the view in its fragment: #eye=..&axes=..&fov=..&distance=..&dial=..&equation=off&wipe=..
 *  axes: right and down. fov: radians across the picture's shorter side, and its width over height. file: from 1. */
export async function copyLink() {
  const { eye, rotation, fov, aspect, distance } = view, parts = { eye, axes: rotation.slice(0, 6), fov: [fov, aspect], distance: [distance] };
  Object.assign(parts, { dial: [state.dial], file: [viewer.file + 1], wipe: state.wipe === null ? [] : [state.wipe] });
  parts.up = viewer.up ? axisOf(viewer.up) : [];
  const texts = Object.entries(parts).filter(([, values]) => values.length).map(([name, values]) =>
    `${name}=${values.map((value) => Number(value.toPrecision(7)))}`);
  history.replaceState(null, "", `#${texts.join("&")}${state.equation ? "" : "&equation=off"}`);
  const copied = viewer.file === null ? "Link copied; it contains the view, not the file" : "Link copied";
  const note = await navigator.clipboard?.writeText(location.href).then(() => copied, () => ""); // file:// pages may not
  ui.showNote(note || "The link is in the address bar");
}

export async function applyLink() {
  const parts = new URLSearchParams(location.hash.slice(1));
  const numbers = (name, length) => {
    const values = (parts.get(name) ?? "x").split(",").map(Number);
    return values.length === length && values.every(Number.isFinite) ? values : [];
  };
  const eye = numbers("eye", 3), axes = numbers("axes", 6), up = numbers("up", 3), [wipe] = numbers("wipe", 1), [dial] = numbers("dial", 1);
  const [fov = view.fov, aspect = view.aspect] = numbers("fov", 2), [distance = view.distance] = numbers("distance", 1);
  const [file = 1] = numbers("file", 1);
  if (viewer.file !== null && file - 1 !== viewer.file) await ui.showFile(file - 1);
  stop();
  if (up.length) [viewer.up, view.up] = [String(up), unit(up)];
  if (eye.length && axes.length) {
    camera.setPose({ eye, down: axes.slice(3), forward: cross(axes.slice(0, 3), axes.slice(3)) });
    select(null);
  }
  Object.assign(view, { fov, aspect, distance });
  state.equation = parts.get("equation") !== "off";
  if (dial !== undefined || wipe !== undefined || !state.equation) ui.setHold(null);
  state.wipe = wipe !== undefined && (stage.model.attenuation || stage.base) ? Math.min(Math.max(wipe, 0), 1) : null;
  state.dial = ui.clampDial(dial ?? state.dial);
  ui.changed();
}

export const isRunning = () => running !== null;

function stop() {
  if (!running) return;
  running = null;
  ui.update();
}

/** Ends what runs. `ended()` is called where the animation ends by itself. */
function run(step, ended) {
  const start = performance.now();
  running = step;
  const tick = (now) => {
    if (running !== step) return;
    const going = step(Math.max(now - start, 0) / 1000);
    moved();
    if (going) return requestAnimationFrame(tick);
    stop();
    ended();
  };
  requestAnimationFrame(tick);
  ui.update();
}

/** Rotates about the pivot; `turns`: how often. */
function turntable(turns, ended) {
  let before = 0;
  run((time) => {
    const now = Math.min(time, turns * TURN);
    camera.rotate((2 * Math.PI * (now - before)) / TURN, 0, true);
    before = now;
    return now < turns * TURN;
  }, ended);
}

/** Moves through the cameras in their order, and selects each that it passes. */
function path(ended) {
  const stride = Math.ceil(viewer.cameras.length / STOPS);
  const stops = viewer.cameras.map((each, number) => ({ ...camera.poseOf(each), number })).filter(({ number }) => number % stride === 0);
  const times = [0];
  for (let k = 1; k < stops.length; k++) times[k] = times[k - 1] + Math.max(far(stops[k - 1], stops[k]) / SPEED, 0.2);
  let passed = -1;
  run((time) => {
    const k = times.findLastIndex((each) => each <= time), going = k + 1 < stops.length;
    if (k !== passed) select(stops[passed = k].number);
    const four = [k - 1, k, k + 1, k + 2].map((i) => stops[Math.min(Math.max(i, 0), stops.length - 1)]);
    camera.setPose(blend(four, going ? (time - times[k]) / (times[k + 1] - times[k]) : 0));
    return going;
  }, ended);
}

/** How far two poses are apart: the angle of their axes plus the distance in units of that to the pivot. */
function far(a, b) {
  const angle = Math.acos(Math.min(Math.max(dot(a.forward, b.forward), -1), 1));
  return angle + Math.hypot(...add(a.eye, b.eye, -1)) / view.distance;
}

/** Catmull and Rom's spline through four poses, from the second (t = 0) to the third (t = 1). */
function blend(poses, t) {
  const weights = [-0.5 * t * (1 - t) ** 2, 1 + t * t * (1.5 * t - 2.5), t * (0.5 + t * (2 - 1.5 * t)), -0.5 * t * t * (1 - t)];
  const sum = (name) => poses.reduce((total, pose, k) => add(total, pose[name], weights[k]), [0, 0, 0]);
  const [, from, to] = poses, mix = (name) => from[name] + t * (to[name] - from[name]);
  return { eye: sum("eye"), forward: sum("forward"), down: sum("down"), fov: mix("fov"), aspect: mix("aspect") };
}

const playOnce = (ended) => (viewer.cameras.length < 2 ? turntable(1, ended) : path(ended));

/** Plays the path through the photographs or, without any, a turn about the pivot, again and again; stops what plays. */
export function play() {
  if (isRunning()) stop();
  else playOnce(play);
}

export function turn() {
  if (isRunning()) return stop();
  select(null);
  turntable(Infinity);
}

function download(blob, suffix) {
  const link = document.createElement("a"), url = URL.createObjectURL(blob);
  const name = `${stage.model.name.replace(/\.[^.]*$/, "")}_s${state.dial.toFixed(2)}.${suffix}`;
  Object.assign(link, { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

export async function savePicture() {
  if (!isRunning()) await stage.whenDrawn();
  stage.redraw();
  elements.canvas.toBlob((blob) => download(blob, "png"));
}

/** Records the path or the turn to its end, or what the camera does until the next call. */
export function record() {
  if (viewer.recording) {
    viewer.recording.stop();
    viewer.recording = null;
    return isRunning() ? stop() : ui.update();
  }
  const stream = elements.canvas.captureStream(FPS);
  viewer.recording = new MediaRecorder(stream, { mimeType: videoType, videoBitsPerSecond: BITS });
  viewer.recording.ondataavailable = ({ data }) => { // once, at its end
    for (const track of stream.getTracks()) track.stop();
    download(data, videoType.includes("mp4") ? "mp4" : "webm");
  };
  viewer.recording.start();
  playOnce(() => viewer.recording && record());
}
