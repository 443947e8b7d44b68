// What the modules of the page share: its elements, its configuration, and what it shows.

/** The elements by id: menuOpen is menu-open. */
export const elements = new Proxy({}, {
  get: (_, name) => document.getElementById(name.replace(/[A-Z]/g, (c) => `-${c.toLowerCase()}`)),
});

export const config = JSON.parse(elements.clodConfig.textContent);

export const state = { dial: 1, equation: true, wipe: null }; // wipe: share of the width that is left of it

export const viewer = {
  files: [config.model, ...config.others], file: 0, // file: a number, null for a dropped one
  cameras: [], cameraNumber: 0, up: "", flying: false, recording: null, opening: null, // opening: the dial value from which the dial moves to what the device holds
  get photographs() { return viewer.cameras.filter(({ placed }) => !placed); },
};

export const ui = {}; // functions of ui.js by name, also for the modules that it imports itself
