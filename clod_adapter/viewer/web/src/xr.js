// Headsets: WebXR sessions, whose frames the stage draws for each eye.
import { add, cross, dot, row, scaled, unit } from "./vector.js";

const REACH = 1.5; // metres to the point that the camera orbits, at the start of a session
const WALK = 1.2, DIAL = 1; // per second at full deflection of a stick: metres; doublings of the dial value

/** The modes of immersive sessions that this browser and its devices support: "immersive-vr", "immersive-ar" or none. */
export async function xrModes() {
  if (!navigator.xr) return [];
  const modes = ["immersive-vr", "immersive-ar"];
  const supported = await Promise.all(modes.map((mode) => navigator.xr.isSessionSupported(mode).catch(() => false)));
  return modes.filter((_, k) => supported[k]);
}

async function prepare(session, gl) {
  await gl.makeXRCompatible();
  const layer = new XRWebGLLayer(session, gl, { antialias: false, depth: false, stencil: false, ignoreDepthValues: true });
  session.updateRenderState({ baseLayer: layer });
  return { layer, space: await session.requestReferenceSpace("local") };
}

/** Starts a session. The headset starts at the camera; its y axis is the camera's up axis. `turnDial(factor)`: of the stick. */
export async function startXr(mode, { renderer, stage, camera, turnDial }, ended) {
  const { gl } = renderer, session = await navigator.xr.requestSession(mode);
  const { layer, space } = await prepare(session, gl).catch(async (error) => {
    await session.end();
    throw error;
  });
  const world = worldOf(camera);
  let last = null;

  function frame(time, xrFrame) {
    session.requestAnimationFrame(frame);
    const viewer = xrFrame.getViewerPose(space), seconds = last === null ? 0 : Math.min((time - last) / 1000, 0.1);
    last = time;
    if (!viewer) return;
    applySticks(session.inputSources, world, world.rotation(viewer.transform.matrix), seconds, turnDial);
    const eyes = viewer.views.map((view) => eyeOf(view, layer.getViewport(view), world, camera.near));
    const head = { ...eyes[0].view, eye: world.place(viewer.transform.matrix), rotation: world.rotation(viewer.transform.matrix) };
    stage.drawEyes(head, eyes, { framebuffer: layer.framebuffer, transparent: mode === "immersive-ar" });
  }

  session.addEventListener("end", () => {
    stage.endEyes();
    ended();
  });
  session.requestAnimationFrame(frame);
  return session;
}

/** The map from the headset's space (x right, y up, z back, metres) to the scene's. */
function worldOf(camera) {
  const up = camera.up, forward = unit(add(row(camera.rotation, 2), up, -dot(row(camera.rotation, 2), up)));
  const axes = [cross(forward, up), up, scaled(forward, -1)], scale = camera.distance / REACH;
  const turned = (v) => axes.reduce((sum, axis, k) => add(sum, axis, v[k]), [0, 0, 0]);
  return {
    origin: camera.eye, scale,
    place(m) { return add(this.origin, turned([m[12], m[13], m[14]]), scale); },
    /** Rows right, down and forward of a pose, in the scene's axes. */
    rotation: (m) => [...turned([m[0], m[1], m[2]]), ...scaled(turned([m[4], m[5], m[6]]), -1), ...scaled(turned([m[8], m[9], m[10]]), -1)],
  };
}

/** The view of an eye: its pinhole is that of the projection matrix. */
function eyeOf({ transform: { matrix }, projectionMatrix: p }, { x, y, width, height }, world, near) {
  return {
    at: [x, y],
    view: {
      rotation: world.rotation(matrix), eye: world.place(matrix), near, width, height,
      fx: (p[0] * width) / 2, fy: (p[5] * height) / 2, cx: ((1 - p[8]) * width) / 2, cy: ((1 + p[9]) * height) / 2,
    },
  };
}

/** The left stick walks where the head looks; the right one, pushed or pulled, decreases or increases the dial value. */
function applySticks(sources, world, rotation, seconds, turnDial) {
  for (const { handedness, gamepad } of sources) {
    const [, , x = 0, y = 0] = gamepad?.axes ?? [];
    if (Math.hypot(x, y) < 0.15) continue;
    if (handedness === "right") turnDial(2 ** (DIAL * y * seconds));
    else world.origin = add(add(world.origin, row(rotation, 0), WALK * world.scale * x * seconds), row(rotation, 2), -WALK * world.scale * y * seconds);
  }
}
