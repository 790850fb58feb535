// The page: reads its data, shows the voxels, and does what the reader asks.
//
// `state` is all that the reader can choose. Every change goes through `show`, which makes the shown grid of it, triangles of
// that, and pictures of those for the images. Frames are drawn only when something has changed.

const $ = (id) => document.getElementById(id);

/** An element with attributes and children; strings become text, whatever they hold. */
function make(tag, attributes = {}, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
    element.append(...children);
    return element;
}

/** The bytes of a base64 text that holds a compressed stream. */
async function unpack(text, format) {
    const packed = Uint8Array.from(atob(text.trim()), (c) => c.charCodeAt(0));
    const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream(format));
    return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** Says on the page, in place of the voxels, why they are not there; nothing if they are. */
function tell(text) {
    $("message").hidden = text === "";
    $("message").textContent = text;
}

// A page that stays empty should at least say why. The first reason is the one that matters.
for (const kind of ["error", "unhandledrejection"]) {
    window.addEventListener(kind, (event) => {
        const reason = event.message || event.reason;
        if (reason && $("message").hidden) tell(`This page failed: ${reason}`);
    });
}

// --- Data ---------------------------------------------------------------------------------------------------------------

const data = JSON.parse($("data").textContent);
const size = data.grid;
const low = data.bounds.map((b) => b[0]);
const high = data.bounds.map((b) => b[1]);
const edge = size.map((n, k) => (high[k] - low[k]) / n);
const step = strides(size);

$("title").textContent = data.title;
$("subtitle").textContent = data.subtitle;
$("subtitle").hidden = data.subtitle === "";

if (typeof DecompressionStream === "undefined") {
    tell("This browser is too old for this page: it cannot unpack compressed data. Any browser of 2023 or later can.");
    throw new Error("no DecompressionStream");
}

const UNLABELLED = 255;
const prediction = await unpack(data.prediction.classes, "deflate");
const truth = data.truth && (await unpack(data.truth.classes, "deflate"));
const support = data.support && new Uint16Array((await unpack(data.support, "deflate")).buffer);
/** The probability that each voxel is occupied, 0 to 255. */
const confidence = data.confidence && (await unpack(data.confidence, "deflate"));

/** Kinds of difference, in the order of their groups from 1 on; red-green blindness leaves their colours apart. */
const DIFFERENCES = [
    { name: "right", note: "the class is that of the truth", rgb: [0, 158, 115] },
    { name: "wrong class", note: "occupied, but by something else", rgb: [240, 190, 40] },
    { name: "missed", note: "in the truth only", rgb: [0, 114, 178] },
    { name: "invented", note: "in the prediction only", rgb: [204, 90, 150] },
];
const UNKNOWN = [128, 136, 150];

/** The kind of difference of a voxel, 0 where there is nothing to compare. */
function difference(index) {
    const [said, is] = [prediction[index], truth[index]];
    if (is === UNLABELLED || (said === 0 && is === 0)) return 0;
    if (said === is) return 1;
    return said === 0 ? 3 : is === 0 ? 4 : 2;
}

const occupied = (classes) => classes.map((c) => (c === UNLABELLED ? 0 : c));
const classGroups = data.classes.map((c, k) => ({ ...c, group: k })).slice(1);

/** What can be shown: a caption, the group of every voxel, and the groups' names and colours. */
const layers = [{ key: "prediction", caption: data.prediction.caption, groups: prediction, legend: classGroups }];
if (truth) {
    const kinds = DIFFERENCES.map((d, k) => ({ ...d, group: k + 1 }));
    layers.push({ key: "truth", caption: data.truth.caption, groups: occupied(truth), legend: classGroups });
    layers.push({ key: "difference", caption: "difference", groups: prediction.map((_, i) => difference(i)), legend: kinds });
}
for (const layer of layers) {
    layer.counts = new Uint32Array(256);
    for (const group of layer.groups) layer.counts[group]++;
    // Classes and kinds of difference are switched off apart from each other.
    layer.off = layer.key === "truth" ? layers[0].off : new Set();
}

const state = { layer: layers[0], low: 0, high: size[2], least: 0, unseen: "hatched", unknown: false, overlay: true, view: "home" };

const thousands = (n) => n.toLocaleString("en").replaceAll(",", "\u2009");
const percent = (part, whole) => (whole === 0 ? "–" : `${(100 * part / whole).toFixed(1)} %`);
const metres = (v) => (Math.abs(v) < 0.005 ? 0 : v).toFixed(2).replace("-", "−");

/** IoU of "occupied" and mIoU over the classes from 1 on that are in either, in words. */
const score = truth && (() => {
    const [both, said, is] = [new Float64Array(256), new Float64Array(256), new Float64Array(256)];
    let [shared, union] = [0, 0];
    for (let i = 0; i < truth.length; i++) {
        const [p, t] = [prediction[i], truth[i]];
        if (t === UNLABELLED) continue;
        said[p]++;
        is[t]++;
        if (p === t) both[p]++;
        if (p && t) shared++;
        if (p || t) union++;
    }
    const ious = classGroups.map(({ group: g }) => [both[g], said[g] + is[g] - both[g]]).filter(([, whole]) => whole > 0);
    const mean = ious.reduce((sum, [part, whole]) => sum + part / whole, 0);
    return `IoU ${percent(shared, union)}, mIoU ${percent(mean, ious.length)}`;
})();

// --- The shown grid -----------------------------------------------------------------------------------------------------

const shown = new Uint16Array((size[0] + 2) * (size[1] + 2) * (size[2] + 2));

/** Fills the shown grid by what the reader has chosen. */
function choose() {
    const { layer, unseen, unknown, least } = state;
    // The truth does not depend on how sure the network is.
    const sure = least > 0 && layer.key !== "truth" && confidence;
    // By group and by whether a camera sees the voxel: what is shown.
    const seen = new Uint16Array(256).map((_, g) => (g && !layer.off.has(g) ? g : 0));
    const blind = seen.map((g) => (unseen === "hidden" ? 0 : g && unseen === "hatched" ? g | GHOST : g));
    if (unknown) blind[0] = GHOST;
    shown.fill(0);
    for (let x = 0; x < size[0]; x++) {
        for (let y = 0; y < size[1]; y++) {
            const from = (x * size[1] + y) * size[2];
            const to = (x + 1) * step[0] + (y + 1) * step[1] + 1;
            for (let z = state.low; z < state.high; z++) {
                if (sure && sure[from + z] < least && prediction[from + z]) continue;
                const group = layer.groups[from + z];
                shown[to + z] = support && support[from + z] === 0 ? blind[group] : seen[group];
            }
        }
    }
}

/** Red, green and blue of every group of the layer; group 0 is unknown space. */
function colours() {
    const list = new Array(256).fill(UNKNOWN);
    for (const { group, rgb } of state.layer.legend) list[group] = rgb;
    return list;
}

// --- Space --------------------------------------------------------------------------------------------------------------

const stage = $("stage");
const canvas = $("space");
const middle = low.map((v, k) => 0.5 * (v + high[k]));
const reach = Math.hypot(high[0] - low[0], high[1] - low[1], high[2] - low[2]);
const ahead = [data.forward[0], data.forward[1], 0];
const left = [-ahead[1], ahead[0], 0];
const FIELD = 38;

/** Metres of the lowest layer in which anything is, on which the voxels stand. */
const floor = (() => {
    let lowest = size[2];
    for (const { groups } of layers) {
        for (let i = 0; i < groups.length; i++) {
            if (groups[i] && i % size[2] < lowest) lowest = i % size[2];
        }
    }
    return low[2] + (lowest === size[2] ? 0 : lowest) * edge[2];
})();

/** Metres of the road under the vehicle, as the columns around it have it. */
const road = (() => {
    const tops = [];
    const around = (a) => [Math.max(0, Math.floor((-6 - low[a]) / edge[a])), Math.min(size[a], Math.ceil((6 - low[a]) / edge[a]))];
    const [xs, ys] = [around(0), around(1)];
    for (let x = xs[0]; x < xs[1]; x++) {
        for (let y = ys[0]; y < ys[1]; y++) {
            const from = (x * size[1] + y) * size[2];
            const at = prediction.subarray(from, from + size[2]).findIndex((c) => c !== 0);
            if (at >= 0) tops.push(at + 1);
        }
    }
    tops.sort((a, b) => a - b);
    return tops.length ? low[2] + edge[2] * tops[tops.length >> 1] : Math.min(Math.max(-1.8, low[2]), high[2]);
})();

const VERTEX = `
precision highp float;
in vec4 place;
uniform mat4 modelViewMatrix, projectionMatrix;
uniform sampler2D palette;
uniform float pixel;
uniform float alone;
out vec3 at;
out vec3 colour;
flat out int side;
flat out float hatched;
void main() {
    int flags = int(place.w);
    side = flags >> 8 & 7;
    hatched = float(flags >> 13 & 1);
    at = place.xyz;
    // Sun from behind and the left, sky from above; corners that voxels stand around are darker.
    float light = (float[6](0.80, 0.74, 0.88, 0.68, 0.55, 1.0))[side];
    float open = float(flags >> 11 & 3);
    colour = texelFetch(palette, ivec2(flags & 255, 0), 0).rgb * light * (0.70 + 0.10 * open);
    // Rectangles of different sizes meet, and rounding would let the ground shine through: each is a little larger.
    vec4 seen = modelViewMatrix * vec4(place.xyz, 1.0);
    int corner = gl_VertexID & 3;
    int axis = side >> 1;
    vec3 out_ = vec3(0.0);
    out_[(axis + 1) % 3] = corner == 1 || corner == 2 ? 1.0 : -1.0;
    out_[(axis + 2) % 3] = corner >= 2 ? 1.0 : -1.0;
    seen += modelViewMatrix * vec4(out_ * (-seen.z * pixel), 0.0);
    gl_Position = projectionMatrix * seen;
    // Over an image, unknown space would hide what the image shows there.
    if (alone > 0.5 && (flags & 255) == 0) gl_Position = vec4(0.0, 0.0, 2.0, 1.0);
}`;

const FRAGMENT = `
precision highp float;
in vec3 at;
in vec3 colour;
flat in int side;
flat in float hatched;
uniform vec3 paper;
uniform float density;
out vec4 pixel_;
void main() {
    vec3 lit = colour;
    // Thin lines between voxels, which fade where they would be finer than a pixel.
    vec2 on = side < 2 ? at.yz : side < 4 ? at.zx : at.xy;
    vec2 width = fwidth(on);
    vec2 near = abs(on - floor(on + 0.5)) / max(width, 1e-6);
    float line = 1.0 - clamp(min(near.x, near.y), 0.0, 1.0);
    lit *= 1.0 - 0.26 * line * clamp(1.0 - 3.2 * max(width.x, width.y), 0.0, 1.0);
    if (hatched > 0.5) {
        if (mod(gl_FragCoord.x + gl_FragCoord.y, 6.0 * density) > 2.6 * density) discard;
        lit = mix(lit, paper, 0.30);
    }
    pixel_ = vec4(lit, 1.0);
}`;

/** Everything that three.js holds, or null where there is no WebGL. */
const space = await (async () => {
    const probe = canvas.getContext("webgl2", { alpha: true, antialias: true, powerPreference: "high-performance" });
    if (!probe) return null;
    const script = make("script");
    script.textContent = new TextDecoder().decode(await unpack($("three").textContent, "gzip"));
    document.head.append(script);
    return new Space(window.THREE, probe);
})();

function Space(T, context) {
    this.renderer = new T.WebGLRenderer({ canvas, context, alpha: true, antialias: true });
    this.renderer.setClearColor(0, 0);
    this.scene = new T.Scene();
    this.camera = new T.PerspectiveCamera(FIELD, 1, 0.2, 8 * reach);
    this.camera.up.set(0, 0, 1);
    this.controls = new T.OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: true, dampingFactor: 0.12, maxDistance: 4 * reach, minDistance: 0.5, zoomToCursor: true });
    this.controls.addEventListener("change", () => this.draw());
    this.controls.addEventListener("start", leave);

    this.palette = new T.DataTexture(new Uint8Array(4 * 256), 256, 1);
    this.uniforms = {
        palette: { value: this.palette }, paper: { value: new T.Color() }, pixel: { value: 0 }, density: { value: 1 }, alone: { value: 0 },
    };
    const material = new T.RawShaderMaterial({
        glslVersion: T.GLSL3, vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: this.uniforms,
    });
    this.voxels = new T.Mesh(new T.BufferGeometry(), material);
    this.voxels.frustumCulled = false;
    this.voxels.position.set(...low);
    this.voxels.scale.set(...edge);

    this.groundCanvas = make("canvas");
    this.groundTexture = new T.CanvasTexture(this.groundCanvas);
    this.groundTexture.colorSpace = "srgb";
    this.groundTexture.anisotropy = this.renderer.capabilities.getMaxAnisotropy();
    const plate = new T.PlaneGeometry(high[0] - low[0], high[1] - low[1]);
    this.ground = new T.Mesh(plate, new T.MeshBasicMaterial({ map: this.groundTexture }));
    this.ground.position.set(middle[0], middle[1], floor - 0.02 * edge[2]);

    // In a grid that is hardly larger than it, or lies elsewhere, the vehicle would hide the rest.
    this.around = [0, 1].every((a) => low[a] <= 0 && high[a] >= 0 && high[a] - low[a] > 12);
    this.vehicle = vehicle(T);
    this.frusta = new T.LineSegments(frusta(T), new T.LineBasicMaterial({ color: 0x2f7df6 }));
    this.marker = new T.LineSegments(box(T), new T.LineBasicMaterial({ color: 0xffffff, depthTest: false }));
    this.marker.scale.set(...edge);
    this.marker.visible = false;
    this.marker.renderOrder = 1;
    this.scene.add(this.voxels, this.ground, this.vehicle, this.frusta, this.marker);

    this.pending = false;
    this.flight = null;
    /** Asks for a frame. */
    this.draw = () => {
        if (this.pending) return;
        this.pending = true;
        canvas.dataset.resting = "false";
        requestAnimationFrame((now) => {
            this.pending = false;
            this.frame(now);
        });
    };
    /** Draws a frame, and asks for the next while something moves. */
    this.frame = (now) => {
        if (this.flight) {
            if (this.flight(now)) this.flight = null;
            this.draw();
        }
        this.controls.update();
        const { camera } = this;
        // What stands at the cameras would be in the way of one who looks from there.
        const inside = Math.hypot(camera.position.x, camera.position.y, camera.position.z - road) < 4;
        this.vehicle.visible = this.frusta.visible = !inside && this.around;
        const height = this.renderer.domElement.height;
        this.uniforms.pixel.value = 0.35 * 2 * Math.tan(camera.fov * Math.PI / 360) / height / Math.min(...edge);
        this.renderer.render(this.scene, camera);
        canvas.dataset.camera = [...camera.position.toArray(), ...this.controls.target.toArray()].map((v) => v.toFixed(3)).join(" ");
        canvas.dataset.resting = !this.pending;
    };
    /** Goes to a place and looks at another, in under half a second unless the reader wants no motion. */
    this.fly = (position, target, field = FIELD) => {
        const { camera, controls } = this;
        const [from, to] = [camera.position.clone(), new T.Vector3(...position)];
        const [looks, look] = [controls.target.clone(), new T.Vector3(...target)];
        const fov = camera.fov;
        const still = matchMedia("(prefers-reduced-motion: reduce)").matches || !document.body.dataset.ready;
        const start = performance.now();
        this.flight = (now) => {
            const t = still ? 1 : Math.min(1, Math.max(0, now - start) / 450);
            const s = t * t * (3 - 2 * t);
            camera.position.lerpVectors(from, to, s);
            controls.target.lerpVectors(looks, look, s);
            camera.fov = fov + (field - fov) * s;
            camera.updateProjectionMatrix();
            return t === 1;
        };
        this.draw();
    };
    /** Takes new triangles and colours. */
    this.take = ({ places, indices }) => {
        const geometry = new T.BufferGeometry();
        geometry.setAttribute("place", new T.BufferAttribute(places, 4));
        geometry.setIndex(new T.BufferAttribute(indices, 1));
        this.voxels.geometry.dispose();
        this.voxels.geometry = geometry;
        colours().forEach((rgb, group) => this.palette.image.data.set([...rgb, 255], 4 * group));
        this.palette.needsUpdate = true;
        this.draw();
    };
    /** Draws the voxels alone into the picture over each image, as its camera sees them. */
    this.lay = () => {
        const eye = new T.PerspectiveCamera();
        const others = [this.ground, this.vehicle, this.frusta, this.marker];
        const visible = others.map((other) => other.visible);
        for (const other of others) other.visible = false;
        this.renderer.setPixelRatio(1);
        this.uniforms.alone.value = 1;
        this.uniforms.pixel.value = 0;
        this.uniforms.density.value = 1;
        for (const { camera, overlay } of images) {
            const context = overlay.getContext("2d");
            context.clearRect(0, 0, overlay.width, overlay.height);
            const rows = projection(camera, 0.5, 8 * reach);
            if (!rows) continue;
            // The eye stays at the origin: the matrix says where the camera stands.
            eye.projectionMatrix.set(...rows);
            eye.projectionMatrixInverse.copy(eye.projectionMatrix).invert();
            this.renderer.setSize(overlay.width, overlay.height, false);
            this.renderer.render(this.scene, eye);
            context.drawImage(canvas, 0, 0);
        }
        this.uniforms.alone.value = 0;
        others.forEach((other, k) => (other.visible = visible[k]));
        this.size();
    };
    /** Fits the picture to the stage, and the view too if the reader has not left it. */
    this.resize = () => {
        hideTip();
        this.size();
        if (state.view) go(state.view);
    };
    this.size = () => {
        const [width, height] = [stage.clientWidth, stage.clientHeight];
        if (!width || !height) return;
        const density = Math.min(2, window.devicePixelRatio || 1);
        this.renderer.setPixelRatio(density);
        this.renderer.setSize(width, height, false);
        this.uniforms.density.value = density;
        this.camera.aspect = width / height;
        this.camera.updateProjectionMatrix();
        this.draw();
    };
}

/** The car that carries the cameras: prisms across its width, on the road at the origin. */
function vehicle(T) {
    const parts = [
        [[[-2.25, 0.3], [2.25, 0.3], [2.3, 0.62], [2.1, 0.8], [0.95, 1], [-2.25, 1.04]], 0.95, 0.96],
        [[[-2.05, 1.02], [1.05, 0.98], [0.25, 1.5], [-1.55, 1.54]], 0.84, 0.2],
        [[[-1.6, 1.5], [0.32, 1.46], [0.2, 1.58], [-1.45, 1.62]], 0.8, 0.96],
        ...[-1.38, 1.42].map((x) => [[[-0.14, 0], [0.14, 0], [0.34, 0.2], [0.34, 0.48], [0.14, 0.68], [-0.14, 0.68], [-0.34, 0.48], [-0.34, 0.2]].map(([a, b]) => [a + x, b]), 0.97, 0.1]),
    ];
    const [positions, tints] = [[], []];
    const place = ([a, up], across) => [0, 1, 2].map((k) => ahead[k] * a + left[k] * across + (k === 2 ? road + up : 0));
    const add = (points, tint) => {
        for (const p of points) {
            positions.push(...p);
            tints.push(tint, tint, tint);
        }
    };
    for (const [outline, half, tone] of parts) {
        outline.forEach((a, i) => {
            const b = outline[(i + 1) % outline.length];
            const [n, up] = [b[1] - a[1], a[0] - b[0]];
            const light = 0.72 + 0.28 * Math.max(0, -up) / Math.hypot(n, up);
            const [p, q, r, s] = [place(a, -half), place(b, -half), place(b, half), place(a, half)];
            add([p, q, r, p, r, s], tone * light);
            for (const y of [-half, half]) {
                if (i > 0 && i < outline.length - 1) add([place(outline[0], y), place(a, y), place(b, y)], tone * 0.8);
            }
        });
    }
    const geometry = new T.BufferGeometry();
    geometry.setAttribute("position", new T.BufferAttribute(new Float32Array(positions), 3));
    geometry.setAttribute("color", new T.BufferAttribute(new Float32Array(tints), 3));
    return new T.Mesh(geometry, new T.MeshBasicMaterial({ vertexColors: true, side: T.DoubleSide }));
}

/** Lines from each camera to the corners of its image a metre and a half ahead. */
function frusta(T) {
    const points = [];
    for (const camera of data.cameras) {
        const stand = pose(camera);
        if (!stand) continue;
        const ends = corners(stand, camera).map((p) => p.map((v, k) => stand.at[k] + 1.5 * (v - stand.at[k])));
        ends.forEach((end, i) => points.push(...stand.at, ...end, ...end, ...ends[(i + 1) % 4]));
    }
    const geometry = new T.BufferGeometry();
    geometry.setAttribute("position", new T.BufferAttribute(new Float32Array(points), 3));
    return geometry;
}

/** The twelve edges of a voxel at the origin. */
function box(T) {
    const points = [];
    for (let a = 0; a < 3; a++) {
        for (const [b, c] of [[0, 0], [0, 1], [1, 0], [1, 1]]) {
            for (const end of [0, 1]) {
                const point = [0, 0, 0];
                [point[a], point[(a + 1) % 3], point[(a + 2) % 3]] = [end, b, c];
                points.push(...point);
            }
        }
    }
    const geometry = new T.BufferGeometry();
    geometry.setAttribute("position", new T.BufferAttribute(new Float32Array(points), 3));
    return geometry;
}

/** From where all of the ground plan is in view, looking along a direction. */
function overlook(direction) {
    const unit = (v) => scaled(v, 1 / Math.hypot(...v));
    const d = unit(direction);
    const right = unit(cross(d, [0, 0, 1]));
    const up = cross(right, d);
    const tangents = [1, stage.clientHeight / Math.max(1, stage.clientWidth)].map((r) => Math.tan(FIELD * Math.PI / 360) / r);
    const limits = [tangents[1], tangents[0]];
    const top = Math.min(high[2], floor + 0.05 * reach);
    const ends = [0, 1, 2, 3, 4, 5, 6, 7].map((n) => {
        return [n & 1 ? high[0] : low[0], n & 2 ? high[1] : low[1], n & 4 ? top : floor];
    });
    let target = [middle[0], middle[1], floor];
    let distance = 1;
    // What is near looks larger: the target moves until the plan is in the middle of the picture.
    for (let round = 0; round < 6; round++) {
        const offsets = ends.map((end) => minus(end, target));
        const beside = (p, k) => dot(p, k ? up : right);
        distance = Math.max(1, ...offsets.flatMap((p) => [0, 1].map((k) => Math.abs(beside(p, k)) / limits[k] - dot(p, d))));
        for (const k of [0, 1]) {
            const slopes = offsets.map((p) => beside(p, k) / (distance + dot(p, d)));
            const shift = 0.5 * (Math.min(...slopes) + Math.max(...slopes)) * distance;
            target = target.map((v, axis) => v + shift * (k ? up : right)[axis]);
        }
    }
    return [minus(target, scaled(d, 1.06 * distance)), target];
}

const VIEWS = {
    home: () => overlook([0, 1, 2].map((k) => 0.97 * ahead[k] + 0.24 * left[k] - (k === 2 ? 0.74 : 0))),
    top: () => overlook([0, 1, 2].map((k) => 0.002 * ahead[k] - (k === 2 ? 1 : 0))),
};

/** The plate under the voxels: hatched where no camera sees any of the column, a line every ten metres. */
function paintGround() {
    const scale = Math.max(2, Math.floor(1536 / Math.max(size[0], size[1])));
    const target = space.groundCanvas;
    [target.width, target.height] = [size[0] * scale, size[1] * scale];
    const context = target.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const tone = (name) => style.getPropertyValue(name).trim();
    context.fillStyle = tone("--plate");
    context.fillRect(0, 0, target.width, target.height);
    if (support) {
        context.save();
        context.beginPath();
        for (let x = 0; x < size[0]; x++) {
            for (let y = 0; y < size[1]; y++) {
                const from = (x * size[1] + y) * size[2];
                if (support.subarray(from, from + size[2]).every((n) => n === 0)) {
                    context.rect(x * scale, (size[1] - 1 - y) * scale, scale, scale);
                }
            }
        }
        context.clip();
        context.strokeStyle = tone("--hatch");
        context.lineWidth = 3;
        context.beginPath();
        for (let at = -target.height; at < target.width; at += 12) {
            context.moveTo(at, target.height);
            context.lineTo(at + target.height, 0);
        }
        context.stroke();
        context.restore();
    }
    context.fillStyle = tone("--rule");
    for (const axis of [0, 1]) {
        for (let at = Math.ceil(low[axis] / 10) * 10; at <= high[axis]; at += 10) {
            const pixel = (at - low[axis]) / edge[axis] * scale;
            if (axis === 0) context.fillRect(pixel - 1, 0, 2, target.height);
            else context.fillRect(0, target.height - pixel - 1, target.width, 2);
        }
    }
    space.groundTexture.dispose();
    space.groundTexture.needsUpdate = true;
    space.uniforms.paper.value.setRGB(...tone("--paper").split(" ").map((v) => Number(v) / 255));
    space.draw();
}

/** Without WebGL: the highest shown voxel of each column, seen from above, ahead being up. */
function paintFlat() {
    const flat = $("flat");
    const swap = Math.abs(ahead[0]) > Math.abs(ahead[1]);
    const [columns, rows] = swap ? [size[1], size[0]] : [size[0], size[1]];
    [flat.width, flat.height] = [columns, rows];
    const context = flat.getContext("2d");
    const picture = context.createImageData(columns, rows);
    const list = colours();
    for (let row = 0; row < rows; row++) {
        for (let column = 0; column < columns; column++) {
            // Ahead is up: along +y with x to the right, or along +x with y to the left, or the reverse of either.
            const flip = swap ? ahead[0] < 0 : ahead[1] < 0;
            const [r, c] = flip ? [rows - 1 - row, columns - 1 - column] : [row, column];
            const [x, y] = swap ? [size[0] - 1 - r, size[1] - 1 - c] : [c, size[1] - 1 - r];
            const base = (x + 1) * step[0] + (y + 1) * step[1] + 1;
            let z = size[2] - 1;
            while (z >= 0 && !shown[base + z]) z--;
            if (z >= 0) picture.data.set([...list[shown[base + z] & 255], shown[base + z] & GHOST ? 130 : 255], 4 * (row * columns + column));
        }
    }
    context.putImageData(picture, 0, 0);
}

// --- Changes ------------------------------------------------------------------------------------------------------------

let later = 0;

/** Brings what is seen in line with `state`. */
function show() {
    hideTip();
    const start = performance.now();
    choose();
    if (space) {
        const triangles = mesh(shown, size);
        space.take(triangles);
        canvas.dataset.triangles = triangles.indices.length / 3;
    } else {
        paintFlat();
    }
    canvas.dataset.layer = state.layer.key;
    canvas.dataset.milliseconds = Math.round(performance.now() - start);
    // Images can wait until the reader's hand rests.
    clearTimeout(later);
    canvas.dataset.laid = "false";
    later = setTimeout(layImages, 60);
}

function layImages() {
    for (const { overlay } of images) overlay.hidden = !state.overlay;
    if (space && state.overlay && images.length > 0) space.lay();
    canvas.dataset.laid = "true";
}

// --- What a voxel is ----------------------------------------------------------------------------------------------------

/** The voxel under a point of the canvas, in CSS pixels from its corner. */
function under(x, y) {
    if (!space) return null;
    const { camera } = space;
    const T = window.THREE;
    const far = new T.Vector3(2 * x / stage.clientWidth - 1, 1 - 2 * y / stage.clientHeight, 0.5).unproject(camera);
    const eye = camera.position.toArray();
    const along = far.toArray().map((v, k) => (v - eye[k]) / edge[k]);
    return meet(shown, size, eye.map((v, k) => (v - low[k]) / edge[k]), along);
}

/** What is known of a voxel: its name, and lines of text. */
function facts([x, y, z]) {
    const index = (x * size[1] + y) * size[2] + z;
    const named = (c) => (c === UNLABELLED ? "no label" : data.classes[c].name);
    const { layer } = state;
    const group = layer.groups[index];
    const lines = [];
    let name = "unknown space";
    let rgb = UNKNOWN;
    if (group) ({ name, rgb } = layer.legend.find((entry) => entry.group === group));
    if (truth) lines.push(`${data.prediction.caption}: ${named(prediction[index])}`, `${data.truth.caption}: ${named(truth[index])}`);
    lines.push(`voxel ${x}, ${y}, ${z}`);
    lines.push([x, y, z].map((v, k) => `${"xyz"[k]} ${metres(low[k] + (v + 0.5) * edge[k])}`).join("  ") + " m");
    if (confidence) lines.push(`occupied with ${percent(confidence[index], 255)}`);
    if (support) lines.push(support[index] ? `seen by ${thousands(support[index])} feature ${support[index] === 1 ? "pixel" : "pixels"}` : layer.key === "prediction" ? "seen by no camera: a guess" : "seen by no camera");
    return { name, rgb, lines };
}

function hideTip() {
    $("tip").hidden = true;
    if (space && space.marker.visible) {
        space.marker.visible = false;
        space.draw();
    }
}

/** Shows what is under a point, or hides the tip if there is nothing; returns the words. */
function showTip(x, y) {
    const hit = under(x, y);
    if (!hit) {
        hideTip();
        return "Nothing is there.";
    }
    const { name, rgb, lines } = facts(hit.cell);
    const tip = $("tip");
    const title = make("strong", {}, swatch(rgb), name);
    tip.replaceChildren(title, ...lines.map((line) => make("span", {}, line)));
    tip.hidden = false;
    const [w, h] = [tip.offsetWidth, tip.offsetHeight];
    tip.style.left = `${Math.max(8, x + 16 + w > stage.clientWidth ? x - 16 - w : x + 16)}px`;
    tip.style.top = `${Math.max(8, Math.min(y + 16, stage.clientHeight - h - 8))}px`;
    space.marker.position.set(...hit.cell.map((v, k) => low[k] + v * edge[k]));
    space.marker.visible = true;
    space.draw();
    return [name, ...lines].join(", ");
}

// --- Controls -----------------------------------------------------------------------------------------------------------

function swatch(rgb) {
    const element = make("i", { class: "swatch" });
    element.style.background = `rgb(${rgb.join(" ")})`;
    return element;
}

function fillFacts() {
    const filled = layers[0].groups.length - layers[0].counts[0];
    const same = edge.every((v) => Math.abs(v - edge[0]) < 1e-4);
    const voxel = same ? `${+edge[0].toFixed(3)} m` : `${edge.map((v) => +v.toFixed(3)).join(" × ")} m`;
    const list = [
        ["Grid", size.join(" × ")],
        ["Voxel", voxel],
        ["Occupied", `${thousands(filled)} (${percent(filled, prediction.length)})`],
        ["Digest", data.digest],
    ];
    if (truth) list.splice(3, 0, ["Score", score]);
    for (const [term, text] of list) $("facts").append(make("div", {}, make("dt", {}, term), make("dd", {}, text)));
    $("facts").title = `voxcast ${data.version}; the digest is the XXH3-64 of the classes`;
}

function fillLayers() {
    if (layers.length === 1) return;
    $("layers").hidden = false;
    for (const layer of layers) {
        const input = make("input", { type: "radio", name: "layer", value: layer.key });
        input.checked = layer === state.layer;
        input.addEventListener("change", () => {
            state.layer = layer;
            fillClasses();
            show();
        });
        $("layers").append(make("label", {}, input, make("span", {}, layer.caption)));
    }
}

/** The legend, which is where groups are switched. Classes that are nowhere are left out. */
function fillClasses() {
    const { layer } = state;
    const counts = layer.key === "difference" ? layer.counts : layers.slice(0, 2).reduce((sum, l) => sum.map((n, k) => n + l.counts[k]), new Uint32Array(256));
    $("classes-title").textContent = layer.key === "difference" ? "Difference" : "Classes";
    $("score").hidden = layer.key !== "difference";
    if (truth) $("score").textContent = score;
    const total = layer.groups.length - layer.counts[0];
    const rows = layer.legend.filter(({ group }) => counts[group] > 0 || layer.key === "difference").map(({ group, name, rgb, note }) => {
        const input = make("input", { type: "checkbox", "data-group": group });
        input.checked = !layer.off.has(group);
        input.addEventListener("change", () => {
            if (input.checked) layer.off.delete(group);
            else layer.off.add(group);
            show();
        });
        const count = layer.counts[group];
        const text = make("span", { class: "name" }, name);
        if (note) text.append(make("small", {}, note));
        const number = make("span", { class: "count", title: percent(count, total) }, thousands(count));
        return make("li", {}, make("label", {}, input, swatch(rgb), text, number));
    });
    $("classes").replaceChildren(...rows);
    if (rows.length === 0) $("classes").append(make("li", { class: "nothing" }, "No voxel is occupied."));
}

function switchAll(on) {
    for (const { group } of state.layer.legend) {
        if (on) state.layer.off.delete(group);
        else state.layer.off.add(group);
    }
    for (const input of $("classes").querySelectorAll("input")) input.checked = on;
    show();
}

/** Two thumbs on one track; they cannot pass each other. */
function fillHeight() {
    const inputs = [$("low"), $("high")];
    let frame = 0;
    const update = () => {
        const [a, b] = [state.low, state.high].map((v) => low[2] + v * edge[2]);
        $("height").textContent = `${metres(a)} to ${metres(b)} m`;
        inputs.forEach((input, k) => input.setAttribute("aria-valuetext", `${metres(k ? b : a)} metres`));
        const track = inputs[0].parentElement;
        track.style.setProperty("--from", state.low / size[2]);
        track.style.setProperty("--to", state.high / size[2]);
        // Where both are at the top, the lower one must be what a finger gets hold of.
        inputs[0].style.zIndex = state.low > size[2] / 2 ? 2 : "";
    };
    inputs.forEach((input, k) => {
        Object.assign(input, { min: 0, max: size[2], step: 1, value: k ? size[2] : 0 });
        input.addEventListener("input", () => {
            if (k) state.high = Math.max(Number(input.value), state.low + 1);
            else state.low = Math.min(Number(input.value), state.high - 1);
            input.value = k ? state.high : state.low;
            update();
            // A slider that is dragged sends more steps than there are frames.
            canvas.dataset.laid = "false";
            if (!frame) {
                frame = requestAnimationFrame(() => {
                    frame = 0;
                    show();
                });
            }
        });
    });
    update();
}

/** One thumb: voxels that are less likely to be occupied are hidden. */
function fillConfidence() {
    $("sure").hidden = !confidence;
    if (!confidence) return;
    const input = $("least");
    const track = input.parentElement;
    let frame = 0;
    const update = () => {
        const text = state.least ? `from ${Math.round(100 * state.least / 255)} %` : "all";
        $("likely").textContent = text;
        input.setAttribute("aria-valuetext", text);
        track.style.setProperty("--from", state.least / 255);
        track.style.setProperty("--to", 1);
    };
    Object.assign(input, { min: 0, max: 255, step: 1, value: 0 });
    input.addEventListener("input", () => {
        state.least = Number(input.value);
        update();
        canvas.dataset.laid = "false";
        frame ||= requestAnimationFrame(() => {
            frame = 0;
            show();
        });
    });
    update();
}

/** "CAM_FRONT_LEFT" as "Front left". */
function cameraTitle(name) {
    const words = name.replace(/^CAM_/, "").replaceAll("_", " ");
    return /[a-z]/.test(words) || words === "" ? words : words[0] + words.slice(1).toLowerCase();
}

const images = [];

function fillCameras() {
    $("cameras").hidden = data.cameras.length === 0;
    for (const camera of data.cameras) {
        const title = cameraTitle(camera.name);
        const picture = make("img", { src: camera.image, alt: "", draggable: "false" });
        picture.style.aspectRatio = `${camera.width} / ${camera.height}`;
        const overlay = make("canvas");
        overlay.width = Math.min(camera.width, 640);
        overlay.height = Math.max(1, Math.round(camera.height * overlay.width / camera.width));
        const button = make("button", { type: "button", title: `See from ${title}` }, picture, overlay, make("span", {}, title));
        button.disabled = !space || !pose(camera);
        button.addEventListener("click", () => {
            const { at, ahead: direction, reach: wide } = pose(camera);
            const aspect = stage.clientWidth / stage.clientHeight;
            const field = 2 * Math.atan(Math.max(wide[1], wide[0] / aspect)) * 180 / Math.PI;
            leave();
            space.fly(at, at.map((v, k) => v + 8 * direction[k]), Math.min(120, field));
            button.setAttribute("aria-current", "true");
            canvas.focus({ preventScroll: true });
            const still = matchMedia("(prefers-reduced-motion: reduce)").matches;
            stage.scrollIntoView({ block: "nearest", behavior: still ? "auto" : "smooth" });
        });
        images.push({ camera, overlay, button });
        const item = make("li", {}, button);
        item.style.setProperty("--aspect", camera.width / camera.height);
        $("images").append(item);
    }
    $("overlay").addEventListener("change", () => {
        state.overlay = $("overlay").checked;
        layImages();
    });
}

/** The reader looks from elsewhere than before: neither from a camera nor as the page began. */
function leave() {
    state.view = null;
    for (const { button } of images) button.removeAttribute("aria-current");
}

function go(view) {
    if (!space) return;
    leave();
    state.view = view;
    space.fly(...VIEWS[view]());
}

/** Turns the camera around what it looks at, by radians, or goes nearer by a factor. */
function turn(sideways, upwards, nearer) {
    leave();
    hideTip();
    const { camera, controls } = space;
    const offset = minus(camera.position.toArray(), controls.target.toArray());
    const distance = Math.hypot(...offset) * nearer;
    const azimuth = Math.atan2(offset[1], offset[0]) + sideways;
    const height = Math.min(1.55, Math.max(-1.55, Math.asin(offset[2] / Math.hypot(...offset)) + upwards));
    const flat = distance * Math.cos(height);
    camera.position.set(
        controls.target.x + flat * Math.cos(azimuth),
        controls.target.y + flat * Math.sin(azimuth),
        controls.target.z + distance * Math.sin(height),
    );
    space.draw();
}

function listen() {
    $("all").addEventListener("click", () => switchAll(true));
    $("none").addEventListener("click", () => switchAll(false));
    $("sight").hidden = !support;
    for (const input of $("unseen").querySelectorAll("input")) {
        input.addEventListener("change", () => {
            state.unseen = input.value;
            show();
        });
    }
    $("unknown").addEventListener("change", () => {
        state.unknown = $("unknown").checked;
        show();
    });
    for (const button of $("views").querySelectorAll("button")) {
        button.addEventListener("click", () => go(button.dataset.view));
    }
    $("theme").addEventListener("click", () => {
        const root = document.documentElement;
        root.dataset.theme = dark() ? "light" : "dark";
        themed();
    });
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", themed);

    canvas.addEventListener("keydown", (event) => {
        const angle = Math.PI / 36;
        const actions = {
            ArrowLeft: () => turn(-angle, 0, 1), ArrowRight: () => turn(angle, 0, 1),
            ArrowUp: () => turn(0, angle, 1), ArrowDown: () => turn(0, -angle, 1),
            "+": () => turn(0, 0, 0.9), "=": () => turn(0, 0, 0.9), "-": () => turn(0, 0, 1 / 0.9),
            h: () => go("home"), t: () => go("top"), Escape: hideTip,
            Enter: () => ($("spoken").textContent = showTip(stage.clientWidth / 2, stage.clientHeight / 2)),
        };
        const action = actions[event.key] || actions[event.key.toLowerCase()];
        if (!space || !action || event.ctrlKey || event.metaKey || event.altKey) return;
        event.preventDefault();
        action();
    });

    // Phones take the context from pages that are not looked at.
    canvas.addEventListener("webglcontextlost", () => tell("The browser took back the memory of this picture."));
    canvas.addEventListener("webglcontextrestored", () => {
        tell("");
        paintGround();
        show();
    });

    let pressed = null;
    let waiting = null;
    const at = (event) => {
        const place = canvas.getBoundingClientRect();
        return [event.clientX - place.left, event.clientY - place.top];
    };
    canvas.addEventListener("pointerdown", (event) => {
        pressed = at(event);
        hideTip();
    });
    canvas.addEventListener("pointerup", (event) => {
        const [x, y] = at(event);
        const still = pressed && Math.hypot(x - pressed[0], y - pressed[1]) < 6;
        pressed = null;
        if (still) showTip(x, y);
    });
    canvas.addEventListener("pointermove", (event) => {
        if (event.pointerType === "touch" || event.buttons) return;
        const first = !waiting;
        waiting = at(event);
        if (first) {
            requestAnimationFrame(() => {
                showTip(...waiting);
                waiting = null;
            });
        }
    });
    canvas.addEventListener("pointerleave", (event) => {
        if (event.pointerType !== "touch") hideTip();
    });
    canvas.addEventListener("wheel", hideTip, { passive: true });
}

function dark() {
    return (document.documentElement.dataset.theme || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light")) === "dark";
}

function themed() {
    $("theme").textContent = dark() ? "☀\ufe0e" : "☾\ufe0e";
    $("theme").setAttribute("aria-pressed", dark());
    if (space) paintGround();
}

// --- Start --------------------------------------------------------------------------------------------------------------

if (!space) {
    canvas.hidden = true;
    $("flat").hidden = false;
    $("views").hidden = true;
    tell("This browser has no WebGL 2, so the voxels are drawn from above. Turning hardware acceleration on, or another browser, shows them in space.");
}
canvas.setAttribute("aria-label", `${size.join(" by ")} voxels of ${data.title}`);
fillFacts();
fillLayers();
fillClasses();
fillHeight();
fillConfidence();
fillCameras();
listen();
themed();
if (space) {
    space.resize();
    new ResizeObserver(space.resize).observe(stage);
}
show();
document.body.dataset.ready = "true";
