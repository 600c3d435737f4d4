// The world in three.js: shapes, contacts, one or two episodes.

import * as THREE from "three";

const SLOW = 24; // [ms] a software renderer that takes longer for a picture draws fewer pixels while things move
const HALF = 20 * Math.PI / 180; // half of the field of view
const FAR = 40; // [m] half the edge of a plane that does not end
const TWIN = new THREE.Color("#E69F00");
const MOST_ARROWS = 64;
const FREE = 0.25; // of the size of what moves: how far its middle may go before the camera follows

export class View {
  /** Draw into a canvas; `pick` is called with the name of a body that was clicked. */
  constructor(canvas, pick) {
    this.canvas = canvas;
    this.software = isSoftware();
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !this.software });
    this.renderer.setScissorTest(true);
    this.camera = new THREE.PerspectiveCamera(40, 1, 0.01, 500);
    this.camera.up.set(0, 0, 1);
    this.controls = new THREE.OrbitControls(this.camera, canvas);
    this.controls.addEventListener("change", () => this.#dirty = true);
    this.scenes = new Map();
    this.meshes = new Map();
    this.lanes = [this.#lane(), this.#lane()];
    this.geometries = new Map();
    this.showContacts = false;
    this.showGoals = true;
    this.beside = false;
    this.twin = false;
    this.period = 0.04;
    this.smooth = false;
    this.frames = 0;
    this.drawn = 0;
    this.framed = false;
    this.pace = 16;
    this.scale = 1;
    this.scaled = this.moved = 0;
    this.#picking(pick);
    this.theme();
    this.#compile();
    new ResizeObserver(() => this.#dirty = true).observe(canvas);
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.theme());
    let before = 0;
    const loop = now => {
      requestAnimationFrame(loop);
      this.pace += 0.1 * (Math.min(200, now - before) - this.pace); // [ms] from one frame to the next
      before = now;
      this.#frame(now);
    };
    requestAnimationFrame(loop);
  }

  #dirty = true;

  #lane() {
    const scene = new THREE.Scene();
    scene.add(new THREE.HemisphereLight("#ffffff", "#8c8c94", 2.0));
    const sun = new THREE.DirectionalLight("#ffffff", 1.6);
    sun.position.set(2, -4, 6);
    scene.add(sun);
    const arrows = new THREE.Group();
    scene.add(arrows);
    return { scene, arrows, number: -1, objects: [], from: null, to: null, at: 0, shapes: [], contacts: [] };
  }

  /** Compile the shaders of all shapes, plain and with tiles, while the world is being built. */
  #compile() {
    const { scene } = this.#lane();
    for (const map of [null, new THREE.CanvasTexture(document.createElement("canvas"))])
      scene.add(new THREE.Mesh(new THREE.PlaneGeometry(), new THREE.MeshLambertMaterial({ map })));
    this.renderer.compile(scene, this.camera);
  }

  theme() {
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    this.sky = new THREE.Color(dark ? "#20262e" : "#dbe5f0");
    this.#dirty = true;
  }

  /** Keep the shapes of a number; meshes come with the first scene that shows them. */
  addScene(message) {
    for (const mesh of message.meshes) this.meshes.set(mesh.mesh, meshGeometry(mesh));
    this.scenes.set(message.scene, message.shapes);
    if (this.scenes.size > 80) this.scenes.delete(this.scenes.keys().next().value);
  }

  forget() {
    this.scenes.clear();
    this.meshes.clear();
    for (const lane of this.lanes) lane.number = -1;
  }

  addFrame(frame) {
    const lane = this.lanes[frame.lane], shapes = this.scenes.get(frame.scene);
    if (!lane || !shapes) return;
    const other = lane.number !== frame.scene;
    if (other) this.#build(lane, frame, shapes);
    const continues = this.smooth && this.pace < 30 && !other && lane.to && frame.step === lane.step + 1;
    lane.from = continues ? lane.to : frame.poses;
    lane.to = frame.poses;
    lane.at = performance.now();
    lane.step = frame.step;
    lane.contacts = frame.contacts;
    let first = 0;
    for (const { geometry } of lane.objects.filter(object => object.userData.soft)) {
      const { array } = geometry.attributes.position;
      array.set(frame.vertices.subarray(first, first += array.length));
      geometry.attributes.position.needsUpdate = true;
      smooth(geometry);
    }
    if (!this.framed && shapes.length) this.home();
    else if (frame.lane === 0) this.#follow();
    this.frames++;
    this.#dirty = true;
  }

  #build(lane, frame, shapes) {
    const before = lane.objects, alike = shape => JSON.stringify({ ...shape, halves: null });
    lane.number = frame.scene;
    lane.shapes = shapes;
    lane.objects = shapes.map((shape, i) => {
      const geometry = this.#geometry(shape), old = before[i];
      if (old && !shape.soft && alike(old.userData) === alike(shape)) { // a tendon has another length at each instant
        if (old.geometry !== geometry && !old.userData.body) old.geometry.dispose();
        old.geometry = geometry;
        old.userData = shape;
        before[i] = null;
        return old;
      }
      const object = new THREE.Mesh(shape.soft ? geometry.clone() : geometry, material(shape, frame.lane === 1));
      object.frustumCulled = !shape.soft; // what bounds it is of its first instant
      object.userData = shape;
      object.matrixAutoUpdate = false;
      object.renderOrder = shape.goal ? 2 : shape.color[3] < 1 ? 1 : 0;
      lane.scene.add(object);
      return object;
    });
    for (const object of before) if (object) lane.scene.remove(object);
  }

  #geometry(shape) {
    if (shape.mesh !== null) return this.meshes.get(shape.mesh) ?? new THREE.BufferGeometry();
    if (!shape.body && shape.moves && !shape.goal) return solid(shape); // it may have another size at each instant
    const key = `${shape.kind} ${shape.halves} ${shape.kind === "plane" ? shape.tiles : ""}`;
    if (!this.geometries.has(key)) this.geometries.set(key, solid(shape));
    return this.geometries.get(key);
  }

  /** Turn the camera to where all that moves is seen. */
  home() {
    const box = new THREE.Box3(), point = new THREE.Vector3();
    const lane = this.lanes[0];
    const seen = lane.shapes.map((s, i) => [s, i]).filter(([s]) => s.kind !== "plane" && s.color[3] > 0);
    const moving = seen.filter(([s]) => s.moves || s.goal);
    for (const [shape, i] of moving.length ? moving : seen) {
      const r = shape.mesh === null ? Math.max(...shape.halves) : this.#geometry(shape).boundingSphere?.radius ?? 0.1;
      point.fromArray(lane.to, 7 * i);
      box.expandByPoint(point.clone().addScalar(r)).expandByPoint(point.clone().addScalar(-r));
    }
    if (box.isEmpty()) box.set(new THREE.Vector3(-1, -1, 0), new THREE.Vector3(1, 1, 1));
    const middle = box.getCenter(new THREE.Vector3());
    const size = box.getSize(point).length() / 2 || 1;
    const away = new THREE.Vector3(0.5, -1, 0.55).normalize().multiplyScalar(2.9 * size);
    this.size = size;
    this.middle = null;
    this.camera.near = size / 100;
    this.camera.far = Math.max(200, 50 * size);
    this.camera.position.copy(middle).add(away);
    this.controls.target.copy(middle);
    this.controls.update();
    this.framed = lane.shapes.length > 0;
    this.#dirty = true;
  }

  /** Move the camera along with what moves, once it has gone some way from the middle. */
  #follow() {
    const { shapes, to } = this.lanes[0], middle = new THREE.Vector3();
    let count = 0;
    shapes.forEach((shape, i) => {
      if (!shape.moves || shape.goal || shape.soft || !(shape.color[3] > 0)) return;
      middle.add(position.fromArray(to, 7 * i));
      count++;
    });
    if (!count) return;
    middle.divideScalar(count);
    this.middle ??= middle.clone();
    const gone = middle.sub(this.middle), far = gone.length() - FREE * this.size;
    if (!(far > 0)) return;
    gone.setLength(far);
    for (const point of [this.middle, this.camera.position, this.controls.target]) point.add(gone);
    this.controls.update();
  }

  redraw() { this.#dirty = true; }

  /** Give a picture of the view to a function, as a PNG. */
  picture(take) {
    this.#dirty = true;
    this.#frame(performance.now());
    this.canvas.toBlob(take); // at once: what was drawn is gone after this task
  }

  turn(dx, dy, zoom = 1) {
    const offset = this.camera.position.clone().sub(this.controls.target).multiplyScalar(zoom);
    offset.applyAxisAngle(this.camera.up, dx);
    const side = new THREE.Vector3().crossVectors(this.camera.up, offset).normalize();
    const turned = offset.clone().applyAxisAngle(side, dy);
    if (Math.abs(turned.clone().normalize().z) < 0.99) offset.copy(turned);
    this.camera.position.copy(this.controls.target).add(offset);
    this.controls.update();
    this.#dirty = true;
  }

  #frame(now) {
    const moving = this.lanes.some(lane => lane.from !== lane.to);
    if (!this.#dirty && !moving) return;
    this.#dirty = false;
    const { canvas, renderer } = this, width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;
    if (moving) this.moved = now;
    else if (now - this.moved > 500) this.scale = 1;
    if (this.software && moving && this.pace > SLOW && now - this.scaled > 400) {
      this.scale = Math.max(0.4, 0.7 * this.scale);
      this.scaled = now;
    }
    if (this.scale < 1) this.#dirty = true; // once more, sharp, when it stands still
    const ratio = this.software ? this.scale : Math.min(devicePixelRatio, 2);
    if (canvas.width !== Math.floor(width * ratio) || canvas.height !== Math.floor(height * ratio)) {
      renderer.setPixelRatio(ratio);
      renderer.setSize(width, height, false);
    }
    const used = this.twin ? this.lanes : this.lanes.slice(0, 1);
    for (const lane of used) this.#pose(lane, now);
    const halves = this.twin && this.beside;
    this.camera.aspect = (halves ? width / 2 : width) / height;
    // In a narrow picture about as much is seen from side to side as in a square one.
    this.camera.fov = 2 * Math.atan(Math.tan(HALF) * Math.max(1, 0.9 / this.camera.aspect)) * 180 / Math.PI;
    this.camera.updateProjectionMatrix();
    renderer.setClearColor(this.sky);
    used.forEach((lane, i) => {
      const x = halves && i ? Math.floor(width / 2) : 0, w = halves ? Math.ceil(width / 2) : width;
      renderer.setViewport(x, 0, w, height);
      renderer.setScissor(x, 0, w, height);
      const overlaid = i === 1 && !halves;
      renderer.autoClear = !overlaid;
      for (const object of lane.objects) {
        const shape = object.userData;
        object.visible = shape.color[3] > 0 && (this.showGoals || !shape.goal) &&
          !(overlaid && (!shape.moves || shape.goal));
        if (i === 1 && !shape.goal) {
          object.material.transparent = overlaid || shape.color[3] < 1;
          object.material.opacity = overlaid ? 0.5 : shape.color[3];
        }
      }
      renderer.render(lane.scene, this.camera);
    });
    this.drawn++;
    this.onDraw?.(now);
  }

  #pose(lane, now) {
    if (!lane.to) return;
    const t = lane.from === lane.to ? 1 : Math.min(1, (now - lane.at) / (1000 * this.period));
    const a = lane.from, b = lane.to;
    lane.objects.forEach((object, i) => {
      const k = 7 * i;
      if (t >= 1) {
        position.fromArray(b, k);
        turned.fromArray(b, k + 3);
      } else {
        position.fromArray(a, k).lerp(other.fromArray(b, k), t);
        turned.fromArray(a, k + 3).slerp(aim.fromArray(b, k + 3), t);
      }
      object.matrix.compose(position, turned, one);
      object.matrixWorldNeedsUpdate = true;
    });
    if (t >= 1) lane.from = lane.to;
    this.#arrows(lane);
  }

  #arrows(lane) {
    const count = this.showContacts ? Math.min(lane.contacts.length / 7, MOST_ARROWS) : 0;
    while (lane.arrows.children.length < count) {
      const arrow = new THREE.ArrowHelper(new THREE.Vector3(0, 0, 1), new THREE.Vector3(), 1, "#D55E00");
      arrow.line.material.depthTest = arrow.cone.material.depthTest = false;
      lane.arrows.add(arrow);
    }
    lane.arrows.children.forEach((arrow, i) => {
      arrow.visible = i < count;
      if (!arrow.visible) return;
      const c = lane.contacts.subarray(7 * i, 7 * i + 7);
      arrow.position.fromArray(c, 0);
      arrow.setDirection(other.fromArray(c, 3).normalize());
      const length = this.size * (0.08 + 0.08 * Math.log1p(c[6]));
      arrow.setLength(length, 0.35 * length, 0.2 * length);
    });
  }

  #picking(pick) {
    let down = null;
    const ray = new THREE.Raycaster();
    this.canvas.addEventListener("pointerdown", e => down = [e.clientX, e.clientY]);
    this.canvas.addEventListener("pointerup", e => {
      if (!down || Math.hypot(e.clientX - down[0], e.clientY - down[1]) > 4) return;
      const box = this.canvas.getBoundingClientRect();
      let x = (e.clientX - box.left) / box.width;
      const halves = this.twin && this.beside, lane = this.lanes[halves && x > 0.5 ? 1 : 0];
      if (halves) x = (x * 2) % 1;
      ray.setFromCamera(new THREE.Vector2(2 * x - 1, 1 - 2 * (e.clientY - box.top) / box.height), this.camera);
      const hit = ray.intersectObjects(lane.objects.filter(o => o.visible))[0]?.object.userData;
      if (hit) pick(hit.goal || hit.body);
    });
  }
}

/** Tell whether WebGL computes on the processor: then edges are not smoothed. */
function isSoftware() {
  const gl = document.createElement("canvas").getContext("webgl2");
  const info = gl?.getExtension("WEBGL_debug_renderer_info");
  const name = info ? gl.getParameter(info.UNMASKED_RENDERER_WEBGL) : "";
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|software/i.test(name);
}

const position = new THREE.Vector3(), other = new THREE.Vector3(), one = new THREE.Vector3(1, 1, 1);
const turned = new THREE.Quaternion(), aim = new THREE.Quaternion();

function material(shape, twin) {
  const [r, g, b, a] = shape.color;
  const color = new THREE.Color().setRGB(r, g, b, THREE.SRGBColorSpace);
  if (twin && shape.moves && !shape.goal) color.lerp(TWIN, 0.55);
  const made = new THREE.MeshLambertMaterial({ color, transparent: a < 1, opacity: a, depthWrite: a >= 1 });
  Object.assign(made, { polygonOffset: twin, polygonOffsetFactor: 2, polygonOffsetUnits: 16 }); // where both are, the factual one is seen
  if (shape.kind === "plane" && shape.tiles) {
    made.map = checker(shape, color);
    made.color.set("#ffffff");
  }
  return made;
}

function checker(shape, first) {
  const canvas = document.createElement("canvas"), context = canvas.getContext("2d");
  canvas.width = canvas.height = 2;
  const second = new THREE.Color().setRGB(...shape.tiles[1], THREE.SRGBColorSpace);
  [[0, 0, first], [1, 0, second], [0, 1, second], [1, 1, first]].forEach(([x, y, color]) => {
    context.fillStyle = `#${color.getHexString()}`;
    context.fillRect(x, y, 1, 1);
  });
  const made = new THREE.CanvasTexture(canvas);
  made.wrapS = made.wrapT = THREE.RepeatWrapping;
  made.magFilter = THREE.NearestFilter;
  made.colorSpace = THREE.SRGBColorSpace;
  return made;
}

/** Make the geometry of a shape in its own frame; round ones lie along its third axis. */
function solid(shape) {
  const [x, y, z] = shape.halves;
  switch (shape.kind) {
    case "box": return new THREE.BoxGeometry(2 * x, 2 * y, 2 * z);
    case "ellipsoid": return new THREE.SphereGeometry(1, 28, 18).scale(x, y, z);
    case "cylinder": return new THREE.CylinderGeometry(1, 1, 2, 40).rotateX(Math.PI / 2).scale(x, y, z);
    case "capsule": return new THREE.CapsuleGeometry(x, Math.max(0, 2 * (z - x)), 6, 20).rotateX(Math.PI / 2);
    case "plane": {
      const w = x > 0 ? x : FAR, h = y > 0 ? y : FAR, made = new THREE.PlaneGeometry(2 * w, 2 * h);
      const [u, v] = shape.tiles ? shape.tiles[0] : [1, 1], uv = made.attributes.uv;
      for (let i = 0; i < uv.count; i++) uv.setXY(i, uv.getX(i) * w / u, uv.getY(i) * h / v);
      return made;
    }
  }
  return new THREE.BufferGeometry();
}

/** Make a mesh of its vertices, normals and the three corners of each triangle; a soft one's normals follow. */
function meshGeometry(mesh) {
  const made = new THREE.BufferGeometry();
  made.setIndex(new THREE.BufferAttribute(mesh.corners, 1));
  made.setAttribute("position", new THREE.BufferAttribute(mesh.vertices, 3));
  if (mesh.normals) made.setAttribute("normal", new THREE.BufferAttribute(mesh.normals, 4, true));
  else smooth(made);
  made.computeBoundingSphere();
  return made;
}

/** Compute the normals of a soft mesh, at each vertex the mean of those of its triangles. */
function smooth(geometry) {
  const p = geometry.attributes.position.array, corners = geometry.index.array, n = new Float32Array(p.length);
  if (!geometry.attributes.normal) geometry.setAttribute("normal", new THREE.BufferAttribute(new Int8Array(4 * p.length / 3), 4, true));
  const normal = geometry.attributes.normal, bytes = normal.array;
  for (let i = 0; i < corners.length; i += 3) {
    const a = 3 * corners[i], b = 3 * corners[i + 1], c = 3 * corners[i + 2];
    const ux = p[b] - p[a], uy = p[b + 1] - p[a + 1], uz = p[b + 2] - p[a + 2];
    const vx = p[c] - p[a], vy = p[c + 1] - p[a + 1], vz = p[c + 2] - p[a + 2];
    const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
    n[a] += x; n[a + 1] += y; n[a + 2] += z;
    n[b] += x; n[b + 1] += y; n[b + 2] += z;
    n[c] += x; n[c + 1] += y; n[c + 2] += z;
  }
  for (let i = 0, k = 0; i < n.length; i += 3, k += 4) {
    const scale = 127 / (Math.hypot(n[i], n[i + 1], n[i + 2]) || 1);
    bytes[k] = n[i] * scale; bytes[k + 1] = n[i + 1] * scale; bytes[k + 2] = n[i + 2] * scale;
  }
  normal.needsUpdate = true;
}
