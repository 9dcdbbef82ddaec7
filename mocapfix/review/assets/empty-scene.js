/** The 3-D view, or what stands for it in a browser without WebGL. */

import { find } from "./elements.js";
import { Scene } from "./scene.js";

class EmptyScene {
  shown = { before: true, after: true, skeleton: true, trails: true, labels: false };
  turn = null;
  setTake() {}
  readColors() {}
  showFrame() {}
  settle() {}
  draw() {}
  advance() {}
  adapt() {}
  setView() {}
  frame() {
    return true;
  }
  project() {
    return null;
  }
  pick() {
    return null;
  }
}

export function createScene(canvas, requestDraw) {
  try {
    return new Scene(canvas, requestDraw);
  } catch (error) {
    const problem = find("scene-problem");
    problem.textContent = `This browser cannot show the 3-D view (${error.message}). All else works.`;
    problem.hidden = false;
    return new EmptyScene();
  }
}
