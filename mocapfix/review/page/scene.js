// The 3-D view: markers before and after cleaning, skeleton, trails and floor.

import { OrbitControls, THREE } from "./three.js";
import { STATE } from "./samples.js";

const COLOURS = { before: 0x6b7480, faulty: 0xff4f4f, relabelled: 0xa98bff, estimated: 0x2fd07a, unlabelled: 0xe0a030 };
const THEMES = { dark: { back: 0x101418, after: 0xc9d0d8, grid: 0x39424c, bone: 0x4f8fd6 },
  light: { back: 0xe9edf1, after: 0x8d98a5, grid: 0xc3cad2, bone: 0x3f7fc4 } };
const SIZES_M = { before: 0.04, after: 0.05, unlabelled: 0.034, estimate: 0.034 };
const MAX_ESTIMATES = 7;
const TRAIL_S = 0.5;
const PICK_RADIUS_PX = 14;
const SLOW_RENDER_MS = 24;
const HIDDEN = null;

export class SceneView {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.camera = new THREE.PerspectiveCamera(45, 1, 0.01, 200);
    this.scene = new THREE.Scene();
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.requestRender());
    this.shown = { before: true, after: true, skeleton: true, trails: true };
    this.layers = {};
    this.selected = [];
    this.needsRender = true;
    this.renderMs = 0;
    this.afterRender = () => {};
    this.colour = new THREE.Color();
    this.point = new THREE.Vector3();
    this.texture = buildDiscTexture();
    this.setTheme(false);
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  setTheme(isDark) {
    this.theme = THEMES[isDark ? "dark" : "light"];
    this.scene.background = new THREE.Color(this.theme.back);
    if (this.grid) this.addFloor(this.floor);
    if (this.bones) this.bones.material.color.set(this.theme.bone);
    this.requestRender();
  }

  setTake(take, samples) {
    this.take = take;
    this.samples = samples;
    this.character = null;
    for (const child of [...this.scene.children]) {
      this.scene.remove(child);
      child.geometry?.dispose();
    }
    for (const name of ["unlabelled", "before", "after"]) this.layers[name] = this.addPoints(samples.counts[name], SIZES_M[name]);
    this.estimates = [];
    this.ghosts = this.addPoints(MAX_ESTIMATES, SIZES_M.estimate);
    this.bones = this.addLines(take.bones.length * 2, this.theme.bone);
    const trailPoints = 2 * (2 * Math.ceil(TRAIL_S * take.rate) + 1);
    this.trails = ["before", "after"].map((name) => this.addLines(trailPoints, name === "before" ? COLOURS.faulty : COLOURS.estimated));
    this.addFloor(take.floor_m);
  }

  addPoints(count, size) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(count * 3), 3).setUsage(THREE.DynamicDrawUsage));
    geometry.setAttribute("color", new THREE.BufferAttribute(new Float32Array(count * 3), 3).setUsage(THREE.DynamicDrawUsage));
    const material = new THREE.PointsMaterial({ size, vertexColors: true, sizeAttenuation: true, map: this.texture, alphaTest: 0.5 });
    const points = new THREE.Points(geometry, material);
    points.frustumCulled = false;
    this.scene.add(points);
    return points;
  }

  addLines(count, colour) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(count * 3), 3).setUsage(THREE.DynamicDrawUsage));
    const lines = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: colour }));
    lines.frustumCulled = false;
    this.scene.add(lines);
    return lines;
  }

  addFloor(height) {
    if (this.grid) this.scene.remove(this.grid);
    this.floor = height;
    this.grid = new THREE.GridHelper(10, 20, this.theme.grid, this.theme.grid);
    this.grid.position.y = height;
    this.scene.add(this.grid);
  }

  // Shows a character beside the body, null for none.
  setCharacter(character) {
    if (this.character) this.scene.remove(this.character.group);
    this.character = character;
    if (character) this.scene.add(character.group);
    if (this.frame !== undefined) this.showFrame(this.frame, this.selected);
  }

  // Shows a frame. `selected` are indices of markers whose trails are drawn.
  showFrame(frame, selected) {
    this.frame = frame;
    this.selected = selected;
    this.updatePoints("before", frame, (m) => this.chooseInputColour(frame, m));
    this.updatePoints("after", frame, (m) => this.chooseOutputColour(frame, m));
    this.updatePoints("unlabelled", frame, () => COLOURS.unlabelled);
    this.updateGhosts(frame);
    this.updateBones(frame);
    this.updateTrails(frame, selected[0]);
    const root = this.samples.counts.joints * 3 * frame;
    const time = (frame - this.take.motion_start) / this.take.rate;
    this.character?.show(time, this.samples.joints.subarray(root, root + 3), this.take.motion_floor_m);
    this.requestRender();
  }

  chooseInputColour(frame, m) {
    const state = this.samples.state[frame * this.samples.counts.after + m];
    if ([STATE.replaced, STATE.suspect, STATE.empty, STATE.rejected].includes(state)) return COLOURS.faulty;
    if (state === STATE.measured) return this.shown.after ? HIDDEN : COLOURS.before;
    return COLOURS.relabelled;
  }

  chooseOutputColour(frame, m) {
    const state = this.samples.state[frame * this.samples.counts.after + m];
    if (state === STATE.filled || state === STATE.replaced) return COLOURS.estimated;
    if (state === STATE.rejected) return COLOURS.faulty;
    return state === STATE.relabelled ? COLOURS.relabelled : this.theme.after;
  }

  updatePoints(name, frame, choose) {
    const layer = this.layers[name], count = this.samples.counts[name], values = this.samples[name];
    const position = layer.geometry.attributes.position, colours = layer.geometry.attributes.color;
    layer.visible = name === "unlabelled" ? this.shown.before : this.shown[name];
    if (!layer.visible) return;
    let shown = 0;
    for (let m = 0, at = frame * count * 3; m < count; m++, at += 3) {
      if (Number.isNaN(values[at])) continue;
      const colour = choose(m);
      if (colour === HIDDEN) continue;
      position.array.set(values.subarray(at, at + 3), shown * 3);
      this.colour.set(colour);
      colours.array.set([this.colour.r, this.colour.g, this.colour.b], shown * 3);
      shown++;
    }
    layer.geometry.setDrawRange(0, shown);
    position.needsUpdate = colours.needsUpdate = true;
  }

  // Shows estimates of a marker beside it: [x, y, z] of each from a frame on, with its colour.
  setEstimates(estimates) {
    this.estimates = estimates;
    if (this.frame !== undefined) this.updateGhosts(this.frame);
    this.requestRender();
  }

  updateGhosts(frame) {
    const { position, color } = this.ghosts.geometry.attributes;
    const shown = this.estimates.map((each) => ({ ...each, at: (frame - each.from) * 3 })).filter(({ layer, at }) => at > 2 && at < layer.values.length - 3 && !Number.isNaN(layer.values[at]));
    shown.forEach(({ layer, at, colour, isActive }, n) => {
      position.array.set(layer.values.subarray(at, at + 3), n * 3);
      this.colour.set(isActive ? 0xffffff : colour).toArray(color.array, n * 3);
    });
    this.ghosts.geometry.setDrawRange(0, shown.length);
    position.needsUpdate = color.needsUpdate = true;
  }

  updateBones(frame) {
    const { bones } = this, position = bones.geometry.attributes.position, values = this.samples.joints;
    const start = frame * this.samples.counts.joints * 3;
    bones.visible = this.shown.skeleton;
    let shown = 0;
    for (const pair of this.take.bones) {
      const [parent, child] = pair.map((joint) => start + joint * 3);
      if (Number.isNaN(values[parent]) || Number.isNaN(values[child])) continue;
      position.array.set(values.subarray(parent, parent + 3), shown++ * 3);
      position.array.set(values.subarray(child, child + 3), shown++ * 3);
    }
    bones.geometry.setDrawRange(0, shown);
    position.needsUpdate = true;
  }

  updateTrails(frame, marker) {
    const reach = Math.ceil(TRAIL_S * this.take.rate);
    ["before", "after"].forEach((name, n) => {
      const lines = this.trails[n], position = lines.geometry.attributes.position;
      lines.visible = this.shown.trails && this.shown[name] && marker !== undefined;
      if (!lines.visible) return;
      let shown = 0, last = null;
      const end = Math.min(frame + reach, this.samples.frameCount - 1);
      for (let t = Math.max(frame - reach, 0); t <= end; t++) {
        const here = this.samples.getPosition(name, t, marker);
        const isKnown = !Number.isNaN(here[0]);
        if (isKnown && last) {
          position.array.set(last, shown++ * 3);
          position.array.set(here, shown++ * 3);
        }
        last = isKnown ? here : null;
      }
      lines.geometry.setDrawRange(0, shown);
      position.needsUpdate = true;
    });
  }

  // Returns the centre and radius of the markers (all by default) in the frame, or null.
  measureExtent(markers) {
    const box = new THREE.Box3();
    const { after, before } = this.samples.counts, indices = markers ?? [...Array(after).keys()];
    for (const [layer, count] of [["after", after], ["before", before]]) {
      for (const m of indices) {
        if (m >= count) continue;
        const [x, y, z] = this.samples.getPosition(layer, this.frame, m);
        if (!Number.isNaN(x)) box.expandByPoint(this.point.set(x, y, z));
      }
    }
    if (box.isEmpty()) return null;
    return { centre: box.getCenter(new THREE.Vector3()), radius: box.getSize(new THREE.Vector3()).length() / 2 };
  }

  // Moves the view so that the markers (all by default) fill it; keeps its direction, or takes the one given.
  frameMarkers(markers, direction, minRadius = 0.35) {
    const extent = this.measureExtent(markers);
    if (!extent) return;
    const towards = direction ? new THREE.Vector3(...direction) : this.camera.position.clone().sub(this.controls.target);
    if (towards.lengthSq() < 1e-9) towards.set(0.6, 0.35, 1);
    const distance = Math.max(extent.radius, minRadius) / Math.sin((this.camera.fov / 2) * (Math.PI / 180)) / Math.min(1, this.camera.aspect);
    this.controls.target.copy(extent.centre);
    this.camera.position.copy(extent.centre).addScaledVector(towards.normalize(), 1.1 * distance);
    this.controls.update();
    this.requestRender();
  }

  // Moves the view along with the markers, from one frame to another.
  follow(fromFrame, toFrame) {
    const [from, to] = [fromFrame, toFrame].map((frame) => this.averagePosition(frame));
    if (!from || !to) return;
    to.sub(from).setY(0);
    this.controls.target.add(to);
    this.camera.position.add(to);
    this.camera.updateMatrixWorld();
  }

  averagePosition(frame) {
    const count = this.samples.counts.after, values = this.samples.after, sum = new THREE.Vector3();
    let known = 0;
    for (let m = 0, at = frame * count * 3; m < count; m++, at += 3) {
      if (Number.isNaN(values[at])) continue;
      sum.add(this.point.set(values[at], values[at + 1], values[at + 2]));
      known++;
    }
    return known ? sum.divideScalar(known) : null;
  }

  // Returns {x, y} of a marker after cleaning (or before) in the canvas, null where it is not shown.
  projectMarker(m, layer = "after") {
    const [x, y, z] = this.samples.getPosition(layer, this.frame, m);
    if (Number.isNaN(x)) return layer === "after" && m < this.samples.counts.before ? this.projectMarker(m, "before") : null;
    this.point.set(x, y, z).project(this.camera);
    if (this.point.z > 1) return null;
    return { x: ((this.point.x + 1) / 2) * this.canvas.clientWidth, y: ((1 - this.point.y) / 2) * this.canvas.clientHeight };
  }

  // Returns {layer, index} of the trajectory nearest to a place in the canvas, null if none is near.
  findTrajectory(x, y) {
    let best = null, nearest = PICK_RADIUS_PX;
    for (const layer of ["after", "before", "unlabelled"]) {
      for (let m = 0; m < this.samples.counts[layer]; m++) {
        const [px, py, pz] = this.samples.getPosition(layer, this.frame, m);
        if (Number.isNaN(px)) continue;
        this.point.set(px, py, pz).project(this.camera);
        const dx = ((this.point.x + 1) / 2) * this.canvas.clientWidth - x, dy = ((1 - this.point.y) / 2) * this.canvas.clientHeight - y;
        const distance = Math.hypot(dx, dy);
        if (distance < nearest) [best, nearest] = [{ layer, index: m }, distance];
      }
    }
    return best;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    this.renderer.setPixelRatio(this.renderMs > SLOW_RENDER_MS ? 1 : Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / Math.max(1, height);
    this.camera.updateProjectionMatrix();
    this.requestRender();
  }

  requestRender() { this.needsRender = true; }

  renderIfNeeded() {
    if (!this.needsRender || !this.take) return;
    this.needsRender = false;
    const start = performance.now();
    this.renderer.render(this.scene, this.camera);
    this.renderMs = 0.9 * this.renderMs + 0.1 * (performance.now() - start);
    this.afterRender();
  }
}

function buildDiscTexture() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 32;
  const context = canvas.getContext("2d");
  context.fillStyle = "#fff";
  context.beginPath();
  context.arc(16, 16, 15, 0, 2 * Math.PI);
  context.fill();
  return new THREE.CanvasTexture(canvas);
}
