// Cameras: where they stand, and how they see.
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

/**
 * The camera's matrix as one of clip space, sixteen numbers row by row: it takes metres to the camera's picture, and depths
 * from `near` to `far` metres to -1 to 1; null for a matrix that no camera has.
 */
function projection({ lidar2img: m, width, height }, near, far) {
    const unit = Math.hypot(m[8], m[9], m[10]);
    if (!(unit > 1e-12)) return null;
    const row = (r) => m.slice(4 * r, 4 * r + 4);
    const [u, v, d] = [row(0), row(1), row(2)];
    // Depths in the matrix's own unit, which need not be a metre.
    const [from, to] = [near * unit, far * unit];
    const depth = d.map((value) => value * (to + from) / (to - from));
    depth[3] -= 2 * to * from / (to - from);
    return [
        ...u.map((value, k) => 2 * value / width - d[k]),
        ...v.map((value, k) => d[k] - 2 * value / height),
        ...depth,
        ...d,
    ];
}
