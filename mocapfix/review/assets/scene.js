/** The 3-D view of a take. It draws only when something changed. */

import { OrbitControls, THREE } from "./three.js";
import { PointLayer, SegmentLayer, drawDisc } from "./layers.js";

const VIEWS = { front: [0, 0, 1], side: [1, 0, 0], top: [0, 1, 0.001] };
const COLORS = ["before", "faulty", "moved", "after", "estimated", "unlabelled", "skeleton", "grid", "ring", "background"];
const TRAIL_S = 0.5, PICK_PX = 12, TURN_MS = 220, FLOOR_CELLS = 30, LEAST_RADIUS_M = 0.3, SLOW_FRAME_MS = 45;

export class Scene {
  constructor(canvas, requestDraw) {
    this.canvas = canvas;
    this.requestDraw = requestDraw;
    this.shown = { before: true, after: true, skeleton: true, trails: true, labels: false };
    this.isSlow = detectSoftwareRendering();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !this.isSlow, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(this.isSlow ? 1 : Math.min(devicePixelRatio, 2));
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.02, 200);
    this.camera.position.set(2.5, 1.8, 4);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.target.set(0, 1, 0);
    this.controls.addEventListener("change", () => this.requestDraw());
    this.controls.addEventListener("start", () => { this.turn = null; });
    this.colors = Object.fromEntries(COLORS.map((name) => [name, new THREE.Color()]));
    this.disc = drawDisc(false);
    this.ring = drawDisc(true);
    this.layers = null;
    this.point = new THREE.Vector3();
  }

  setTake(take) {
    for (const layer of Object.values(this.layers ?? {})) layer.dispose();
    const trailFrames = 2 * Math.ceil(TRAIL_S * take.rate) + 2;
    const texture = this.disc, leastPixels = this.isSlow ? 4 : 4 * this.renderer.getPixelRatio();
    this.take = take;
    this.layers = {
      skeleton: new SegmentLayer(take.bones.length, 1),
      trails: new SegmentLayer(2 * trailFrames, 2),
      before: new PointLayer(take.labels.length, { size: 0.075, order: 3, texture, leastPixels: leastPixels + 1 }),
      after: new PointLayer(take.labels.length, { size: 0.056, order: 4, texture, leastPixels }),
      unlabelled: new PointLayer(take.unlabelled.length, { size: 0.045, order: 5, texture, leastPixels }),
      rings: new PointLayer(2 * take.labels.length, { size: 0.15, order: 6, texture: this.ring, leastPixels: 3 * leastPixels, isOnTop: true }),
    };
    for (const layer of Object.values(this.layers)) this.scene.add(layer.object);
    this.placeFloor(0, 0);
  }

  placeFloor(x, z) {
    if (this.grid) {
      this.grid.removeFromParent();
      this.grid.geometry.dispose();
      this.grid.material.dispose();
    }
    this.grid = new THREE.GridHelper(FLOOR_CELLS, FLOOR_CELLS, this.colors.grid, this.colors.grid);
    this.grid.position.set(Math.round(x), this.take.floor_m, Math.round(z));
    this.scene.add(this.grid);
  }

  /** Put the floor under the markers of a frame. */
  settle(samples, frame) {
    let x = 0, z = 0, number = 0;
    for (let m = 0; m < samples.markerCount; m += 1) {
      const offset = 3 * (frame * samples.markerCount + m);
      if (Number.isNaN(samples.after[offset])) continue;
      x += samples.after[offset];
      z += samples.after[offset + 2];
      number += 1;
    }
    if (number) this.placeFloor(x / number, z / number);
  }

  readColors() {
    const style = getComputedStyle(document.documentElement);
    for (const name of COLORS) this.colors[name].set(style.getPropertyValue(`--scene-${name}`).trim());
    this.scene.background = this.colors.background;
    if (this.take) this.placeFloor(this.grid.position.x, this.grid.position.z);
  }

  /** Write the samples of a frame into the buffers; `marker` has the trail, `markers` have rings. */
  showFrame(samples, frame, marker, markers) {
    const { layers, colors, shown } = this;
    for (const layer of Object.values(layers)) layer.begin();
    for (let m = 0; m < samples.markerCount; m += 1) {
      const offset = 3 * (frame * samples.markerCount + m);
      if (shown.before) layers.before.add(samples.before, offset, this.chooseBeforeColor(samples, frame, m));
      if (shown.after) layers.after.add(samples.after, offset, this.chooseAfterColor(samples, frame, m));
    }
    for (let u = 0; u < samples.trajectoryCount; u += 1) {
      layers.unlabelled.add(samples.unlabelled, 3 * (frame * samples.trajectoryCount + u), colors.unlabelled);
    }
    if (shown.skeleton) {
      for (const [parent, child] of this.take.bones) {
        const start = frame * samples.jointCount;
        layers.skeleton.add(samples.joints, 3 * (start + parent), 3 * (start + child), colors.skeleton);
      }
    }
    if (shown.trails && marker >= 0) this.writeTrails(samples, frame, marker);
    for (const m of markers) {
      const offset = 3 * (frame * samples.markerCount + m);
      const isAfter = shown.after && !Number.isNaN(samples.after[offset]);
      layers.rings.add(isAfter ? samples.after : samples.before, offset, colors.ring);
    }
    for (const layer of Object.values(layers)) layer.finish();
  }

  writeTrails(samples, frame, marker) {
    const reach = Math.ceil(TRAIL_S * this.take.rate), width = 3 * samples.markerCount;
    const last = Math.min(samples.frameCount - 1, frame + reach);
    for (let each = Math.max(1, frame - reach + 1); each <= last; each += 1) {
      const to = each * width + 3 * marker, from = to - width;
      if (this.shown.before) this.layers.trails.add(samples.before, from, to, this.chooseBeforeColor(samples, each, marker));
      if (this.shown.after) this.layers.trails.add(samples.after, from, to, this.chooseAfterColor(samples, each, marker));
    }
  }

  chooseBeforeColor(samples, frame, marker) {
    if (samples.isBeforeFaulty(frame, marker)) return this.colors.faulty;
    return samples.isBeforeMoved(frame, marker) ? this.colors.moved : this.colors.before;
  }

  chooseAfterColor(samples, frame, marker) {
    if (samples.isEstimated(frame, marker)) return this.colors.estimated;
    return samples.isRelabelled(frame, marker) ? this.colors.moved : this.colors.after;
  }

  draw() {
    this.resize();
    this.renderer.render(this.scene, this.camera);
  }

  /** Move the camera along its turn; whether it has further to go. */
  advance(now) {
    if (!this.turn) return false;
    const part = Math.min(1, (now - this.turn.start) / TURN_MS), eased = part * (2 - part);
    this.controls.target.lerpVectors(this.turn.fromTarget, this.turn.toTarget, eased);
    this.camera.position.lerpVectors(this.turn.fromPosition, this.turn.toPosition, eased);
    if (part === 1) this.turn = null;
    this.controls.update();
    return Boolean(this.turn);
  }

  resize() {
    const width = this.canvas.clientWidth, height = this.canvas.clientHeight;
    if (!width || !height || (width === this.width && height === this.height)) return;
    [this.width, this.height] = [width, height];
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  /** Lower the resolution if frames take long. */
  adapt(frameMs) {
    if (frameMs < SLOW_FRAME_MS || this.renderer.getPixelRatio() <= 1) return;
    this.renderer.setPixelRatio(1);
  }

  /** Show markers, or the whole take without them, from the direction of now or from another. */
  frame(samples, frame, markers, direction, isAtOnce) {
    const box = new THREE.Box3();
    const include = (array, offset) => {
      if (!Number.isNaN(array[offset])) box.expandByPoint(this.point.fromArray(array, offset));
    };
    const width = 3 * samples.markerCount;
    if (markers) {
      for (const m of markers) {
        include(samples.after, frame * width + 3 * m);
        include(samples.before, frame * width + 3 * m);
      }
    } else {
      const step = Math.max(1, Math.ceil(samples.frameCount / 300));
      for (let each = 0; each < samples.frameCount; each += step) {
        for (let m = 0; m < samples.markerCount; m += 1) include(samples.after, each * width + 3 * m);
      }
    }
    if (box.isEmpty()) return false;
    const toTarget = box.getCenter(new THREE.Vector3());
    const radius = Math.max(LEAST_RADIUS_M, box.getSize(new THREE.Vector3()).length() / 2);
    const tangent = Math.tan(this.camera.fov * Math.PI / 360) * Math.min(1, this.camera.aspect);
    const distance = markers ? 1.5 * radius / tangent : 1.05 * radius / tangent;
    this.startTurn(toTarget, distance, direction, isAtOnce);
    return true;
  }

  setView(name) {
    const distance = this.camera.position.distanceTo(this.controls.target);
    this.startTurn(this.controls.target.clone(), distance, VIEWS[name], false);
  }

  startTurn(toTarget, distance, direction, isAtOnce) {
    const fromPosition = this.camera.position.clone(), fromTarget = this.controls.target.clone();
    const offset = direction ? new THREE.Vector3(...direction) : fromPosition.clone().sub(fromTarget);
    const toPosition = toTarget.clone().add(offset.normalize().multiplyScalar(distance));
    const isStill = isAtOnce || matchMedia("(prefers-reduced-motion: reduce)").matches;
    const start = isStill ? -Infinity : performance.now();
    this.turn = { start, fromPosition, fromTarget, toPosition, toTarget };
    if (isStill) this.advance(performance.now());
    this.requestDraw();
  }

  /** Position on the canvas of a sample in pixels; null if it is missing or behind the camera. */
  project(array, offset) {
    if (Number.isNaN(array[offset])) return null;
    this.point.fromArray(array, offset).project(this.camera);
    if (this.point.z > 1) return null;
    return [(this.point.x + 1) * this.canvas.clientWidth / 2, (1 - this.point.y) * this.canvas.clientHeight / 2];
  }

  /** The trajectory nearest to a place on the canvas, as {layer, index, place}. */
  pick(samples, frame, x, y) {
    let nearest = null, least = PICK_PX;
    const layers = [["after", samples.after, samples.markerCount, this.shown.after],
      ["before", samples.before, samples.markerCount, this.shown.before],
      ["unlabelled", samples.unlabelled, samples.trajectoryCount, true]];
    for (const [layer, array, count, isShown] of layers) {
      for (let index = 0; isShown && index < count; index += 1) {
        const place = this.project(array, 3 * (frame * count + index));
        const distance = place ? Math.hypot(place[0] - x, place[1] - y) : Infinity;
        if (distance < least) [nearest, least] = [{ layer, index, place }, distance];
      }
    }
    return nearest;
  }
}

function detectSoftwareRendering() {
  const context = document.createElement("canvas").getContext("webgl2");
  const names = context?.getExtension("WEBGL_debug_renderer_info");
  const name = context ? String(context.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : context.RENDERER)) : "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software|basic render/i.test(name);
}
