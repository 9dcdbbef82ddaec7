// The 3-D view: the people, the floor and a character, in one picture or in two beside each other, and the camera.

import { OrbitControls, THREE } from "./three.js";
import { LAYER, Person } from "./person.js";

const COLOUR_NAMES = ["scene", "before", "after", "faulty", "estimated", "relabelled", "unlabelled", "grid", "bone", "link", "body"];
const FIELD_OF_VIEW_DEG = 32;
const FLOOR_M = 10, FLOOR_TILES = 20;
const PICK_RADIUS_PX = 14;
const SLOW_RENDER_MS = 24;
const MARGIN_M = 0.12, MARKERS_MARGIN_M = 0.35, MARGIN_PX = 12;  // around the body, chosen markers and their estimates, in pixels
const MAX_STRAY_M = 0.4;  // distance of faulty markers from the others up to which they are framed
export const FIRST_DIRECTION = [0.45, 0.2, 1];  // of the view: to the left of the performer, up, in front

export class SceneView {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, powerPreference: "high-performance" });
    this.renderer.setScissorTest(true);
    this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW_DEG, 1, 0.01, 200);
    this.scene = new THREE.Scene();
    this.sun = new THREE.DirectionalLight(0xffffff, 1.6);
    this.sun.position.set(1, 3, 2);
    this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8a8f98, 1.9), this.sun);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.requestRender());
    this.shown = { before: true, after: true, skeleton: true, body: true, sticks: true, trails: true, ghost: false, follow: true };
    this.people = [];
    this.division = "one";  // or "states": before and after, or "people"
    this.selected = [];
    this.needsRender = true;
    this.renderMs = 0;
    this.afterRender = () => {};
    this.point = new THREE.Vector3();
    this.place = new THREE.Vector3();
    this.setTheme();
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
  }

  // Takes the colours of the page.
  setTheme() {
    const style = getComputedStyle(document.documentElement);
    this.colours = Object.fromEntries(COLOUR_NAMES.map((name) => [name, new THREE.Color(style.getPropertyValue(`--${name}`).trim())]));
    this.scene.background = this.colours.scene;
    if (this.grid) this.addFloor(this.floor);
    for (const person of this.people) person.setColours(this.colours);
    this.requestRender();
  }

  setTake(take, samples) {
    for (const person of this.people) person.dispose();
    Object.assign(this, { take, samples, people: [] });
    this.setCharacter(null);
    this.addPerson(take, samples);
    this.addFloor(take.floor_m);
  }

  // Adds a person of the same file; the first is the one under review.
  addPerson(take, samples) {
    const person = new Person(take, samples, this.people.length === 0);
    person.setColours(this.colours);
    this.people.push(person);
    this.scene.add(person.group);
    if (this.people.length > 1) this.update();
  }

  addFloor(height) {
    if (this.grid) this.scene.remove(this.grid);
    this.floor = height;
    this.grid = new THREE.GridHelper(FLOOR_M, FLOOR_TILES, this.colours.grid, this.colours.grid);
    this.grid.position.y = height;
    this.scene.add(this.grid);
  }

  // Shows a character beside the body, null for none.
  setCharacter(character) {
    if (this.character) this.scene.remove(this.character.group);
    this.character = character;
    if (character) this.scene.add(character.group);
    this.update();
  }

  // Shows the frame again, after a change of what is shown.
  update() { if (this.frame !== undefined && this.people.length) this.showFrame(this.frame, this.selected); }

  setDivision(division) {
    this.division = division;
    document.getElementById("stage").classList.toggle("divided", division !== "one");
    document.getElementById("picture-names").replaceChildren(...this.listPictures().map(([, , name]) => Object.assign(document.createElement("span"), { textContent: name })));
    this.resize();
    this.update();
    this.frameMarkers(null);
  }

  // Shows a frame. `selected` are indices of markers, of which the path of the first is drawn.
  showFrame(frame, selected) {
    Object.assign(this, { frame, selected });
    const hasWholeInput = this.division === "states" || this.shown.ghost || !this.shown.after;
    for (const person of this.people) person.showFrame(frame, selected[0], this.shown, hasWholeInput);
    if (this.character) {
      const start = this.people[0].startOf(frame);
      this.character.show((frame - this.take.motion_start) / this.take.rate, this.samples.joints.subarray(start, start + 3), this.take.motion_floor_m);
    }
    this.requestRender();
  }

  // Shows estimates of a marker beside it: [x, y, z] of each from a frame on, with its colour.
  setEstimates(estimates) {
    this.people[0].estimates = estimates;
    this.update();
  }

  // Returns the pictures beside each other: the layers of each, its person, and its name.
  listPictures() {
    if (this.division === "states") return [[LAYER.before, this.people[0], "before"], [LAYER.after, this.people[0], "after"]];
    if (this.division === "people") return this.people.map((person) => [null, person, person.take.subject]);
    return [[null, this.people[0], ""]];
  }

  // The picture in which labels stand and markers are picked: { left, width } in pixels.
  get labelledPicture() {
    const { length } = this.listPictures(), width = this.canvas.clientWidth / length;
    return { left: this.division === "states" ? width : 0, width };
  }

  // Returns the box of the markers (all by default) and the body in the frame; faulty ones enlarge it a little only.
  measureBox(markers) {
    const box = new THREE.Box3(), { samples } = this, { after, before, joints } = samples.counts;
    const add = (layer, indices, limits = null) => {
      for (const m of indices) {
        this.point.fromArray(samples[layer], (this.frame * samples.counts[layer] + m) * 3);
        if (!Number.isNaN(this.point.x)) box.expandByPoint(limits ? this.point.clamp(limits.min, limits.max) : this.point);
      }
    };
    add("after", markers ?? Array(after).keys());
    if (!markers) add("joints", Array(joints).keys());
    else for (const { at, layer } of this.people[0].listEstimates(this.frame)) box.expandByPoint(this.point.fromArray(layer.values, at));
    const limits = markers || box.isEmpty() ? null : box.clone().expandByScalar(MAX_STRAY_M);
    add("before", markers?.filter((m) => m < before) ?? Array(before).keys(), limits);
    return box.isEmpty() ? null : box.expandByScalar(markers ? MARKERS_MARGIN_M : MARGIN_M);
  }

  // Returns a direction from the performer, [left, up, front], in the world.
  turn([left, up, front]) {
    const [x, , z] = this.people[0].side;
    return [left * x - front * z, up, left * z + front * x];
  }

  // The share of the picture's half height and half width that is free of boxes: above, below, beside the middle.
  measureFreeShares() {
    const { clientHeight: height } = this.canvas, { width } = this.labelledPicture, box = document.getElementById(this.division === "one" ? "view-bar" : "legend");
    return [[box.offsetTop + box.offsetHeight + MARGIN_PX / 2, height], [MARGIN_PX, height], [MARGIN_PX, width]].map(([used, size]) => Math.max(0.3, 1 - (2 * used) / size));
  }

  // Moves the view so that the markers (all by default) fill it; keeps its direction, or takes the one given: see `turn`.
  frameMarkers(markers, direction) {
    const box = this.measureBox(markers);
    if (!box) return;
    const towards = direction ? new THREE.Vector3(...this.turn(direction)) : this.camera.position.clone().sub(this.controls.target);
    if (towards.lengthSq() < 1e-9) towards.set(...this.turn(FIRST_DIRECTION));
    towards.normalize();
    const right = new THREE.Vector3(0, 1, 0).cross(towards).normalize(), up = towards.clone().cross(right);
    const slope = Math.tan((this.camera.fov / 2) * (Math.PI / 180)), [above, below, beside] = this.measureFreeShares();
    const [top, bottom, side] = [slope * above, slope * below, slope * this.camera.aspect * beside];
    // The planes of the free part of the picture, each moved outwards to the outermost corner.
    const reach = (axis, sign, tangent) => Math.max(...listCorners(box).map((corner) => sign * corner.dot(axis) + tangent * corner.dot(towards)));
    const edges = [reach(right, 1, side), reach(right, -1, side), reach(up, 1, top), reach(up, -1, bottom)];
    const distance = Math.max((edges[0] + edges[1]) / (2 * side), (edges[2] + edges[3]) / (top + bottom));
    const x = (edges[0] - edges[1]) / 2, y = (edges[2] - top * distance + bottom * distance - edges[3]) / 2;
    const centre = box.getCenter(new THREE.Vector3());
    this.camera.position.set(0, 0, 0).addScaledVector(right, x).addScaledVector(up, y).addScaledVector(towards, distance);
    this.controls.target.copy(this.camera.position).addScaledVector(towards, centre.dot(towards) - distance);
    this.controls.update();
    this.camera.updateMatrixWorld();
    this.requestRender();
  }

  // Moves the view along with the performer from one frame to another; after a jump the whole body is in the picture.
  follow(fromFrame, toFrame, isJump) {
    const [person] = this.people;
    this.frame = toFrame;
    if (!this.shown.follow || fromFrame === undefined) return;
    if (person.locate(fromFrame, this.point) && person.locate(toFrame, this.place)) {
      this.place.sub(this.point).setY(0);
      this.controls.target.add(this.place);
      this.camera.position.add(this.place);
      this.camera.updateMatrixWorld();
    }
    if (isJump && !this.isWholeBodyShown()) this.frameMarkers(null);
  }

  isWholeBodyShown() {
    const box = this.measureBox(null), [above, below, beside] = this.measureFreeShares();
    return !box || listCorners(box.expandByScalar(-MARGIN_M)).every((corner) => {
      const { x, y, z } = corner.project(this.camera);
      return z < 1 && Math.abs(x) <= beside && y <= above && y >= -below;
    });
  }

  // Sets `point` to a place in the canvas in pixels; returns whether the trajectory is shown there.
  projectTrajectory(layer, m, picture = this.labelledPicture, { samples } = this) {
    const { point } = this;
    point.fromArray(samples[layer], (this.frame * samples.counts[layer] + m) * 3);
    if (Number.isNaN(point.x)) return false;
    point.project(this.camera);
    point.x = picture.left + ((point.x + 1) / 2) * picture.width;
    point.y = ((1 - point.y) / 2) * this.canvas.clientHeight;
    return point.z < 1;
  }

  // Returns {x, y} of a marker after cleaning (or before) in the canvas, null where it is not shown.
  projectMarker(m, layer = "after", person = this.people[0]) {
    if (this.projectTrajectory(layer, m, this.labelledPicture, person)) return { x: this.point.x, y: this.point.y };
    return layer === "after" && this.projectTrajectory("before", m) ? { x: this.point.x, y: this.point.y } : null;
  }

  // Returns {layer, index, person} of the trajectory nearest to a place in the canvas, null if none is near.
  findTrajectory(x, y) {
    let best = null, nearest = PICK_RADIUS_PX;
    const picture = this.labelledPicture;
    const people = this.people.slice(0, this.division === "people" ? 1 : undefined);
    for (const [person, layer] of people.flatMap((each) => (each.isChosen ? ["after", "before", "unlabelled"] : ["after"]).map((name) => [each, name]))) {
      for (let m = 0; m < person.samples.counts[layer]; m++) {
        if (!this.projectTrajectory(layer, m, picture, person)) continue;
        const distance = Math.hypot(this.point.x - x, this.point.y - y);
        if (distance < nearest) [best, nearest] = [{ layer, index: m, person }, distance];
      }
    }
    return best;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    this.renderer.setPixelRatio(this.renderMs > SLOW_RENDER_MS ? 1 : Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / this.listPictures().length / Math.max(1, height);
    this.camera.updateProjectionMatrix();
    this.requestRender();
  }

  requestRender() { this.needsRender = true; }

  renderIfNeeded() {
    if (!this.needsRender || !this.take) return;
    this.needsRender = false;
    const start = performance.now(), pictures = this.listPictures(), { clientHeight: height } = this.canvas;
    const distance = this.camera.position.distanceTo(this.controls.target);
    for (const person of this.people) person.scaleMarkers(distance, height);
    pictures.forEach((picture, n) => this.renderPicture(picture, (n * this.canvas.clientWidth) / pictures.length, this.canvas.clientWidth / pictures.length));
    this.renderMs = 0.9 * this.renderMs + 0.1 * (performance.now() - start);
    this.afterRender();
  }

  renderPicture([layer, person], left, width) {
    const { camera, canvas, people, frame } = this;
    this.renderer.setViewport(left, 0, width, canvas.clientHeight);
    this.renderer.setScissor(left, 0, width, canvas.clientHeight);
    if (layer) camera.layers.set(0);
    for (const each of Object.values(LAYER)) if (!layer || each === layer) camera.layers.enable(each);
    const isOther = person !== people[0] && people[0].locate(frame, this.point) && person.locate(frame, this.place);
    if (isOther) camera.position.add(this.place.sub(this.point));
    this.renderer.render(this.scene, camera);
    if (isOther) camera.position.sub(this.place);
    if (isOther) camera.updateMatrixWorld();  // labels are placed with it
  }
}

const listCorners = ({ min, max }) => [...Array(8).keys()].map((n) => new THREE.Vector3(n & 1 ? max.x : min.x, n & 2 ? max.y : min.y, n & 4 ? max.z : min.z));
