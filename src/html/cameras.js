// Cameras: where they stand, and voxels laid over their images.
//
// A camera's matrix takes metres (x, y, z, 1) to (u d, v d, d, 1), with u and v in pixels of the original image and d the
// depth. Its rows are combinations of the camera's axes, from which these are found again.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const scaled = (a, s) => a.map((v) => v * s);
const minus = (a, b) => a.map((v, k) => v - b[k]);

/**
 * Where a camera stands (`at`), looks (`ahead`), what is down in its image (`down`), and half the tangents that it sees to
 * the sides and up and down (`reach`); null for a matrix that no camera has.
 */
function pose({ lidar2img: m, width, height }) {
    const rows = [0, 1, 2].map((r) => [m[4 * r], m[4 * r + 1], m[4 * r + 2]]);
    const shift = [m[3], m[7], m[11]];
    const determinant = dot(rows[0], cross(rows[1], rows[2]));
    const depth = Math.hypot(...rows[2]);
    if (!(Math.abs(determinant) > 1e-12) || !(depth > 1e-12)) return null;
    // Cramer: the point that all three rows take to 0.
    const columns = [cross(rows[1], rows[2]), cross(rows[2], rows[0]), cross(rows[0], rows[1])];
    const at = [0, 1, 2].map((k) => -columns.reduce((sum, c, r) => sum + c[k] * shift[r], 0) / determinant);
    const ahead = scaled(rows[2], 1 / depth);
    const across = (row) => minus(row, scaled(ahead, dot(row, ahead)));
    const focal = [0, 1].map((k) => Math.hypot(...across(rows[k])) / depth);
    const centre = [0, 1].map((k) => dot(rows[k], ahead) / depth);
    const down = across(rows[1]);
    const right = across(rows[0]);
    if (!(focal[0] > 1e-9) || !(focal[1] > 1e-9)) return null;
    const unit = (a) => scaled(a, 1 / Math.hypot(...a));
    const far = (c, size, f) => Math.max(c, size - c) / f;
    return {
        at, ahead, down: unit(down), right: unit(right), centre, focal,
        reach: [far(centre[0], width, focal[0]), far(centre[1], height, focal[1])],
    };
}

/** The four corners of a camera's image, one metre ahead of it. */
function corners({ at, ahead, down, right, centre, focal }, { width, height }) {
    return [[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) => {
        const [x, y] = [(u - centre[0]) / focal[0], (v - centre[1]) / focal[1]];
        return at.map((p, k) => p + ahead[k] + x * right[k] + y * down[k]);
    });
}

/** Bordered indices and centres in metres of the shown voxels that have a side open. */
function surface(shown, size, low, edge) {
    const step = strides(size);
    const found = { at: [], centres: [] };
    for (let x = 0; x < size[0]; x++) {
        for (let y = 0; y < size[1]; y++) {
            let at = (x + 1) * step[0] + (y + 1) * step[1] + 1;
            for (let z = 0; z < size[2]; z++, at++) {
                if (!shown[at]) continue;
                const inside = shown[at - 1] && shown[at + 1] && shown[at - step[1]] && shown[at + step[1]]
                    && shown[at - step[0]] && shown[at + step[0]];
                if (inside) continue;
                found.at.push(at);
                found.centres.push(low[0] + (x + 0.5) * edge[0], low[1] + (y + 0.5) * edge[1], low[2] + (z + 0.5) * edge[2]);
            }
        }
    }
    return found;
}

/**
 * Draws the centre of each voxel of a surface as a square that shrinks with the distance, the nearest on top. `colours` are
 * 32-bit pixels per group. Returns how many voxels are in the picture.
 */
function lay(canvas, camera, { at, centres }, shown, colours, edge) {
    const [w, h] = [canvas.width, canvas.height];
    const context = canvas.getContext("2d");
    const picture = context.createImageData(w, h);
    const pixels = new Uint32Array(picture.data.buffer);
    const depths = new Float32Array(w * h).fill(Infinity);
    const m = camera.lidar2img;
    const scale = [w / camera.width, h / camera.height];
    const stand = pose(camera);
    const focal = stand ? stand.focal[0] * scale[0] : w;
    const metric = stand ? 1 / Math.hypot(m[8], m[9], m[10]) : 1;
    let count = 0;
    for (let n = 0; n < at.length; n++) {
        const [x, y, z] = [centres[3 * n], centres[3 * n + 1], centres[3 * n + 2]];
        const d = m[8] * x + m[9] * y + m[10] * z + m[11];
        if (!(d * metric > 0.5)) continue;
        const u = (m[0] * x + m[1] * y + m[2] * z + m[3]) / d * scale[0];
        const v = (m[4] * x + m[5] * y + m[6] * z + m[7]) / d * scale[1];
        if (!(u >= 0 && u < w && v >= 0 && v < h)) continue;
        count++;
        const half = Math.min(Math.max(0.28 * edge * focal / (d * metric), 0.8), 9);
        const colour = colours[shown[at[n]] & 255];
        const [left, right] = [Math.max(0, Math.round(u - half)), Math.min(w, Math.round(u + half))];
        const [top, bottom] = [Math.max(0, Math.round(v - half)), Math.min(h, Math.round(v + half))];
        for (let row = top; row < bottom; row++) {
            for (let to = row * w + left; to < row * w + right; to++) {
                if (d < depths[to]) {
                    depths[to] = d;
                    pixels[to] = colour;
                }
            }
        }
    }
    context.putImageData(picture, 0, 0);
    return count;
}

