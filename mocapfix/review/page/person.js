// What the 3-D view shows of one person: markers, sticks between them, the body, and the path of a marker.

import { THREE } from "./three.js";
import { STATE } from "./samples.js";

export const LAYER = { before: 1, after: 2 };  // of the halves of the view; what is on neither is in both
const RADII_M = { bone: 0.014, link: 0.004, ghost: 0.006, trail: 0.005 };
const SIZES_M = { before: 0.042, after: 0.05, unlabelled: 0.036, estimates: 0.036 };
const MAX_ESTIMATES = 7;
const MIN_MARKER_PX = 7;
const TRAIL_S = 0.5;
const BODY_OPACITY = 0.32;
const SHOULDERS = /shoulder|clav|collar/i, FLAT_PARTS = /spine|back|chest|hip|pelvis|abdomen/i, FLAT_WIDTH = 1.5;
// Radii in metres of the parts of a body, by the name of the joint at which each begins.
const PART_RADII_M = [[/head/i, 0.088], [/neck/i, 0.055], [/up_?leg|thigh/i, 0.075], [/foot|toe/i, 0.038], [/leg|shin|calf/i, 0.052],
  [SHOULDERS, 0.05], [/fore_?arm/i, 0.036], [/arm|shldr/i, 0.045], [/hand|thumb|finger|index/i, 0.026], [FLAT_PARTS, 0.095]];
const OTHER_RADIUS_M = 0.03;
const HIP_PATTERNS = [/left_?(up|thigh)|^(.*[:_])?l_?(up_?leg|thigh)|(up_?leg|thigh)[._]l/i, /right_?(up|thigh)|^(.*[:_])?r_?(up_?leg|thigh)|(up_?leg|thigh)[._]r/i];
const TIP_M = { head: 0.13, other: 0.04 };  // length of a part beyond the last joint

// Sticks or parts of a body, each between two points: instances of one shape of unit length and radius along +Y.
class Sticks {
  constructor(parent, count, geometry, materials, layer) {
    this.meshes = materials.map((material, pass) => {
      const mesh = new THREE.InstancedMesh(geometry, material, Math.max(1, count));
      mesh.frustumCulled = false;
      mesh.renderOrder = materials.length > 1 ? 1 + pass : 0;
      if (layer) mesh.layers.set(layer);
      parent.add(mesh);
      return mesh;
    });
    this.matrices = this.meshes[0].instanceMatrix.setUsage(THREE.DynamicDrawUsage);
    for (const mesh of this.meshes) mesh.instanceMatrix = this.matrices;  // passes over the same parts
    this.count = 0;
  }

  set isVisible(isVisible) { for (const mesh of this.meshes) mesh.visible = isVisible; }
  get isVisible() { return this.meshes[0].visible; }

  // Adds one between the points at two places of arrays, longer by `reach` at both ends, and `width` times as wide along `side`.
  add(from, a, to, b, radius, reach = 0, side = null, width = 1) {
    const x = from[a], y = from[a + 1], z = from[a + 2];
    let dx = to[b] - x, dy = to[b + 1] - y, dz = to[b + 2] - z;
    const length = Math.hypot(dx, dy, dz);
    if (!(length > 1e-6)) return;  // also if a point is unknown
    [dx, dy, dz] = [dx / length, dy / length, dz / length];
    let [sx, sy, sz] = side ?? (Math.abs(dy) > 0.9 ? [1, 0, 0] : [0, 1, 0]);
    const along = sx * dx + sy * dy + sz * dz;
    [sx, sy, sz] = [sx - along * dx, sy - along * dy, sz - along * dz];
    const scale = radius / Math.max(1e-6, Math.hypot(sx, sy, sz)), across = scale * width, whole = length + 2 * reach;
    const m = this.matrices.array, at = 16 * this.count++;
    m[at] = sx * across, m[at + 1] = sy * across, m[at + 2] = sz * across, m[at + 3] = 0;
    m[at + 4] = dx * whole, m[at + 5] = dy * whole, m[at + 6] = dz * whole, m[at + 7] = 0;
    m[at + 8] = (sy * dz - sz * dy) * scale, m[at + 9] = (sz * dx - sx * dz) * scale, m[at + 10] = (sx * dy - sy * dx) * scale, m[at + 11] = 0;
    m[at + 12] = x - dx * reach, m[at + 13] = y - dy * reach, m[at + 14] = z - dz * reach, m[at + 15] = 1;
  }

  finish() {
    for (const mesh of this.meshes) mesh.count = this.count;
    this.matrices.needsUpdate = true;
    this.count = 0;
  }
}

export class Person {
  // `isChosen`: whether it is the person under review, of whom also what was before cleaning is shown.
  constructor(take, samples, isChosen) {
    Object.assign(this, { take, samples, isChosen, group: new THREE.Group(), layers: {}, side: [1, 0, 0] });
    const { group } = this, round = new THREE.CylinderGeometry(1, 1, 1, 7, 1, true).translate(0, 0.5, 0);
    for (const name of isChosen ? ["unlabelled", "before", "after", "estimates"] : ["after"]) this.layers[name] = this.addPoints(name, samples.counts[name] ?? MAX_ESTIMATES);
    this.estimates = [];
    const basic = () => [new THREE.MeshBasicMaterial()], reach = 2 * Math.ceil(TRAIL_S * take.rate);
    this.bones = new Sticks(group, take.bones.length, round, [new THREE.MeshLambertMaterial()], LAYER.after);
    this.links = new Sticks(group, take.sticks.length, round, basic(), LAYER.after);
    [this.ghost, this.faults] = [0, 1].map(() => new Sticks(group, take.sticks.length, round, basic(), LAYER.before));
    this.trails = ["before", "after"].map((name) => new Sticks(group, reach, round, basic(), LAYER[name]));
    // The first pass hides all but the nearest surface, so that parts which overlap are not seen through each other.
    this.parts = listParts(take);
    this.body = new Sticks(group, this.parts.length, buildPartGeometry(), [new THREE.MeshBasicMaterial({ colorWrite: false, transparent: true }),
      new THREE.MeshLambertMaterial({ transparent: true, opacity: BODY_OPACITY, depthFunc: THREE.LessEqualDepth })], LAYER.after);
    this.tip = new Float32Array(3);
    this.hips = HIP_PATTERNS.map((pattern) => take.joints.findIndex((name) => pattern.test(name)));
    if (this.hips.includes(-1)) this.hips = [-1, -1];  // the view is then from the world's axes
  }

  addPoints(name, count) {
    const geometry = new THREE.BufferGeometry();
    for (const attribute of ["position", "color"]) {
      geometry.setAttribute(attribute, new THREE.BufferAttribute(new Float32Array(count * 3), 3).setUsage(THREE.DynamicDrawUsage));
    }
    const points = new THREE.Points(geometry, new THREE.PointsMaterial({ vertexColors: true, map: DISC, alphaTest: 0.5 }));
    points.frustumCulled = false;
    if (LAYER[name]) points.layers.set(LAYER[name]);
    this.group.add(points);
    return points;
  }

  setColours(colours) {
    const rgb = (name) => colours[name].toArray();
    const output = Array(8).fill(rgb("after")), input = Array(8).fill(rgb("relabelled"));
    output[STATE.filled] = output[STATE.replaced] = rgb("estimated");
    output[STATE.rejected] = rgb("faulty");
    output[STATE.relabelled] = rgb("relabelled");
    input[STATE.measured] = rgb("before");
    for (const name of ["replaced", "suspect", "empty", "rejected"]) input[STATE[name]] = rgb("faulty");
    this.colours = { before: input, after: output, unlabelled: Array(8).fill(rgb("unlabelled")) };
    const pairs = [[this.bones, "bone"], [this.links, "link"], [this.ghost, "before"], [this.faults, "faulty"], [this.body, "body"], [this.trails[0], "faulty"], [this.trails[1], "estimated"]];
    for (const [sticks, name] of pairs) for (const mesh of sticks.meshes) mesh.material.color.copy(colours[name]);
  }

  // Shows a frame. `marker` is the one whose path is drawn; with `hasWholeInput` also the samples that no change concerns.
  showFrame(frame, marker, shown, hasWholeInput) {
    this.frame = frame;
    this.updateSide();
    if (this.isChosen) this.updateEstimates(frame);
    for (const name of Object.keys(this.colours)) {
      if (!this.layers[name]) continue;
      this.layers[name].visible = name === "unlabelled" ? shown.before : shown[name] || (name === "before" && shown.ghost);
      if (this.layers[name].visible) this.updatePoints(name, frame, name === "before" && !hasWholeInput);
    }
    this.bones.isVisible = shown.skeleton;
    this.body.isVisible = shown.body;
    if (shown.skeleton) this.updateBones(frame);
    if (shown.body) this.updateBody(frame);
    this.links.isVisible = shown.sticks && shown.after;
    if (this.links.isVisible) this.updateLinks("after", frame, RADII_M.link, this.links, this.links);
    this.ghost.isVisible = this.faults.isVisible = this.isChosen && hasWholeInput && (shown.ghost || shown.before);
    if (this.ghost.isVisible) this.updateLinks("before", frame, RADII_M.ghost, this.ghost, this.faults);
    ["before", "after"].forEach((name, n) => {
      this.trails[n].isVisible = shown.trails && shown[name] && marker !== undefined && this.isChosen;
      if (this.trails[n].isVisible) this.updateTrail(this.trails[n], name, frame, marker);
    });
  }

  updatePoints(name, frame, hasChangesOnly) {
    const { geometry } = this.layers[name], { position, color } = geometry.attributes;
    const count = this.samples.counts[name], values = this.samples[name], { state } = this.samples, colours = this.colours[name];
    const isLabelled = name !== "unlabelled";
    let shown = 0;
    for (let m = 0, at = frame * count * 3; m < count; m++, at += 3) {
      if (Number.isNaN(values[at])) continue;
      const outcome = isLabelled ? state[frame * count + m] : 0;
      if (hasChangesOnly && outcome === STATE.measured) continue;
      const colour = colours[outcome];
      for (let axis = 0; axis < 3; axis++) {
        position.array[shown * 3 + axis] = values[at + axis];
        color.array[shown * 3 + axis] = colour[axis];
      }
      shown++;
    }
    geometry.setDrawRange(0, shown);
    position.needsUpdate = color.needsUpdate = true;
  }

  // The estimates that have a sample in a frame; `at` is where it begins in their values.
  listEstimates(frame) {
    return this.estimates.map((each) => ({ ...each, at: (frame - each.from) * 3 })).filter(({ layer, at }) => at > 2 && at < layer.values.length - 3 && !Number.isNaN(layer.values[at]));
  }

  updateEstimates(frame) {
    const { geometry } = this.layers.estimates, { position, color } = geometry.attributes;
    const shown = this.listEstimates(frame);
    shown.forEach(({ layer, at, colour, isActive }, n) => {
      position.array.set(layer.values.subarray(at, at + 3), n * 3);
      new THREE.Color(isActive ? 0xffffff : colour).toArray(color.array, n * 3);
    });
    geometry.setDrawRange(0, shown.length);
    position.needsUpdate = color.needsUpdate = true;
  }

  // Where the joints of a frame begin in the samples.
  startOf(frame) { return frame * this.samples.counts.joints * 3; }

  // The direction to the left of the pelvis, level; it stays where it was if it is unknown.
  updateSide() {
    const { joints } = this.samples, [left, right] = this.hips.map((joint) => this.startOf(this.frame) + joint * 3);
    const x = joints[left] - joints[right], z = joints[left + 2] - joints[right + 2], length = Math.hypot(x, z);
    if (length > 0.02) [this.side[0], this.side[2]] = [x / length, z / length];
  }

  updateBones(frame) {
    const start = this.startOf(frame), { joints } = this.samples;
    for (const [parent, child] of this.take.bones) this.bones.add(joints, start + parent * 3, joints, start + child * 3, RADII_M.bone);
    this.bones.finish();
  }

  updateBody(frame) {
    const start = this.startOf(frame), { joints } = this.samples, { tip } = this;
    for (const { parent, child, length, radius, isFlat } of this.parts) {
      const a = start + parent * 3, b = start + child * 3, reach = 0.7 * radius;
      if (!length) {
        this.body.add(joints, a, joints, b, radius, reach, isFlat ? this.side : null, isFlat ? FLAT_WIDTH : 1);
        continue;
      }
      const distance = Math.hypot(joints[b] - joints[a], joints[b + 1] - joints[a + 1], joints[b + 2] - joints[a + 2]);
      for (let axis = 0; axis < 3; axis++) tip[axis] = joints[b + axis] + ((joints[b + axis] - joints[a + axis]) * length) / distance;
      this.body.add(joints, b, tip, 0, radius, 0.4 * radius);
    }
    this.body.finish();
  }

  // Shows the sticks between markers; those of which an end is not as measured as `changed`.
  updateLinks(name, frame, radius, measured, changed) {
    const values = this.samples[name], { state } = this.samples, start = frame * this.samples.counts[name];
    for (const [one, other] of this.take.sticks) {
      const isMeasured = state[start + one] === STATE.measured && state[start + other] === STATE.measured;
      (isMeasured ? measured : changed).add(values, (start + one) * 3, values, (start + other) * 3, radius);
    }
    measured.finish();
    if (changed !== measured) changed.finish();
  }

  updateTrail(sticks, name, frame, marker) {
    const reach = Math.ceil(TRAIL_S * this.take.rate), count = this.samples.counts[name], values = this.samples[name];
    const end = Math.min(frame + reach, this.samples.frameCount - 1);
    for (let t = Math.max(frame - reach, 0); t < end; t++) {
      sticks.add(values, (t * count + marker) * 3, values, ((t + 1) * count + marker) * 3, RADII_M.trail);
    }
    sticks.finish();
  }

  // Gives the markers their size at a distance in metres, in a picture of a height in pixels.
  scaleMarkers(distance, height) {
    for (const name of Object.keys(this.layers)) {
      this.layers[name].material.size = Math.max(SIZES_M[name], (SIZES_M[name] / SIZES_M.after) * ((2 * MIN_MARKER_PX * distance) / height));
    }
  }

  // Sets a point to the place of the person in a frame: between the hips, else the mean of the markers. Returns whether it is known.
  locate(frame, point) {
    const { joints, after, counts } = this.samples, [left, right] = this.hips.map((joint) => this.startOf(frame) + Math.max(0, joint) * 3);
    point.set(0, 0, 0);
    if (counts.joints && joints[left] + joints[right] < Infinity) {
      return Boolean(point.set((joints[left] + joints[right]) / 2, (joints[left + 1] + joints[right + 1]) / 2, (joints[left + 2] + joints[right + 2]) / 2));
    }
    let known = 0;
    for (let m = 0, at = frame * counts.after * 3; m < counts.after; m++, at += 3) {
      if (Number.isNaN(after[at])) continue;
      point.x += after[at];
      point.y += after[at + 1];
      point.z += after[at + 2];
      known++;
    }
    point.divideScalar(Math.max(1, known));
    return known > 0;
  }

  dispose() {
    this.group.traverse((each) => {
      each.geometry?.dispose();
      each.material?.dispose();
    });
    this.group.removeFromParent();
  }
}

// Returns the parts of a body: the joints at their ends, and for those beyond a last joint a length in metres.
function listParts({ bones, joints }) {
  const parents = new Set(bones.map(([parent]) => parent));
  const describe = (name) => ({ radius: PART_RADII_M.find(([pattern]) => pattern.test(name))?.[1] ?? OTHER_RADIUS_M, isFlat: FLAT_PARTS.test(name) });
  return bones.filter(([parent, child]) => !(FLAT_PARTS.test(joints[parent]) && SHOULDERS.test(joints[child]))).flatMap(([parent, child]) => [
    { parent, child, length: 0, ...describe(joints[parent]) },
    ...(parents.has(child) ? [] : [{ parent, child, length: /head/i.test(joints[child]) ? TIP_M.head : TIP_M.other, ...describe(joints[child]) }]),
  ]);
}

// A part of a body of unit length and radius, round at both ends and thinner towards the second.
function buildPartGeometry() {
  const profile = [...Array(7).keys()].map((n) => {
    const y = -Math.cos((n / 6) * Math.PI), radius = Math.cbrt(Math.max(0, 1 - Math.abs(y) ** 3)) * (1 - 0.12 * y);
    return new THREE.Vector2(radius, (1 + y) / 2);
  });
  return new THREE.LatheGeometry(profile, 9);
}

const DISC = buildDiscTexture();

// A disc with a darker edge, so that markers are told from the background and from each other.
function buildDiscTexture() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 32;
  const context = canvas.getContext("2d");
  for (const [radius, colour] of [[15, "#777"], [11.5, "#fff"]]) {
    context.fillStyle = colour;
    context.beginPath();
    context.arc(16, 16, radius, 0, 2 * Math.PI);
    context.fill();
  }
  return new THREE.CanvasTexture(canvas);
}
