import type { SplatMesh } from "@sparkjsdev/spark";
import type { WebGLRenderer } from "three";
import type { Dial } from "./types.js";

export type { Dial, DialFile } from "./types.js";

/** `mesh` was made from `bytes`, without `lod`; it has one dial. */
export function attach(mesh: SplatMesh, bytes: ArrayBuffer | Uint8Array, renderer: WebGLRenderer): Promise<Dial>;
