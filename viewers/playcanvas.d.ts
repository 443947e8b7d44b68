import type { AppBase, Entity } from "playcanvas";
import type { Dial, DialFile } from "./types.js";

export type { Dial, DialFile } from "./types.js";

/** `entity` has a loaded gsplat with an adapted PLY, and one dial; distances are from `camera`. */
export function attach(app: AppBase, entity: Entity, camera: Entity): Dial;

/** The modifier for `gsplat.setWorkBufferModifier`. */
export function modifier(file: DialFile): { glsl: string; wgsl: string };
