// Voxels to triangles.
//
// A shown grid has one number per voxel and a border of one empty voxel all around, so that no neighbour need be looked for
// in vain: 0 is nothing, else the group (a class, or a kind of difference) in the low 8 bits, and GHOST for voxels that are
// drawn hatched.

const GHOST = 256;

/** Steps from a voxel of a bordered grid to its neighbours along x, y, z. */
function strides([, ny, nz]) {
    return [(ny + 2) * (nz + 2), nz + 2, 1];
}

/** A list of numbers that grows. */
class Growing {
    constructor(Type, length) {
        this.array = new Type(length);
        this.length = 0;
    }

    /** Makes room for `count` more and returns where they begin. */
    take(count) {
        const at = this.length;
        this.length += count;
        if (this.length > this.array.length) {
            const larger = new this.array.constructor(2 * this.length);
            larger.set(this.array);
            this.array = larger;
        }
        return at;
    }
}

/**
 * The faces of a shown grid that something may be seen through to: those next to nothing, and those of solid voxels next to
 * ghosts. Equal neighbours are joined into rectangles where their corners are equally dark.
 *
 * Returns `places`, four numbers per corner (x, y, z in voxels; group, side << 8, openness << 11 and ghost << 13), and
 * `indices`, six per rectangle. Openness is 3 for a corner with no voxel in front of it, down to 0 in a corner of three.
 */
function mesh(shown, size) {
    const places = new Growing(Uint16Array, 1 << 16);
    const indices = new Growing(Uint32Array, 1 << 15);
    const step = strides(size);
    for (let axis = 0; axis < 3; axis++) {
        const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
        const mask = new Int32Array(size[u] * size[v]);
        for (const side of [0, 1]) {
            const front = side ? step[axis] : -step[axis];
            for (let layer = 0; layer < size[axis]; layer++) {
                if (expose(shown, mask, (layer + 1) * step[axis] + step[u] + step[v], front, step[u], step[v], size[u], size[v])) {
                    join(mask, size[u], size[v], (i, j, w, h, cell) => {
                        quad(places, indices, axis, u, v, side, layer + side, i, j, w, h, cell);
                    });
                }
            }
        }
    }
    return {
        places: places.array.subarray(0, places.length),
        indices: indices.array.subarray(0, indices.length),
    };
}

/**
 * The faces of one layer of voxels towards `front`: 0 or the voxel, and two bits from 9 on for each corner's openness.
 * Returns whether there is one.
 */
function expose(shown, mask, first, front, du, dv, nu, nv) {
    const solid = (at) => (shown[at] - 1) >>> 0 < GHOST - 1 ? 1 : 0;
    let any = false;
    for (let j = 0, cell = 0; j < nv; j++) {
        for (let i = 0, at = first + j * dv; i < nu; i++, at += du, cell++) {
            const voxel = shown[at];
            const before = voxel === 0 ? 0 : shown[at + front];
            if (voxel === 0 || (before !== 0 && (voxel >= GHOST || before < GHOST))) {
                mask[cell] = 0;
                continue;
            }
            any = true;
            const f = at + front;
            const [l, r, d, t] = [solid(f - du), solid(f + du), solid(f - dv), solid(f + dv)];
            const open = (a, b, corner) => (a & b ? 0 : 3 - a - b - solid(corner));
            mask[cell] = voxel | open(l, d, f - du - dv) << 9 | open(r, d, f + du - dv) << 11
                | open(r, t, f + du + dv) << 13 | open(l, t, f - du + dv) << 15;
        }
    }
    return any;
}

/** Hands out rectangles of equal cells whose corners are all alike, and every other cell by itself; clears the mask. */
function join(mask, nu, nv, emit) {
    for (let j = 0; j < nv; j++) {
        for (let i = 0; i < nu;) {
            const at = j * nu + i;
            const cell = mask[at];
            if (cell === 0) {
                i++;
                continue;
            }
            const corners = cell >> 9;
            let [w, h] = [1, 1];
            if (corners === (corners & 3) * 0b01010101) {
                while (i + w < nu && mask[at + w] === cell) w++;
                grow: for (; j + h < nv; h++) {
                    for (let k = 0; k < w; k++) {
                        if (mask[at + h * nu + k] !== cell) break grow;
                    }
                }
            }
            for (let k = 0; k < h; k++) mask.fill(0, at + k * nu, at + k * nu + w);
            emit(i, j, w, h, cell);
            i += w;
        }
    }
}

/** Appends a rectangle, anticlockwise as seen from outside. */
function quad(places, indices, axis, u, v, side, layer, i, j, w, h, cell) {
    const base = places.length / 4;
    const flags = (cell & 255) | (axis * 2 + side) << 8 | (cell & GHOST ? 1 << 13 : 0);
    const open = [9, 11, 13, 15].map((shift) => (cell >> shift) & 3);
    let at = places.take(16);
    for (let corner = 0; corner < 4; corner++, at += 4) {
        places.array[at + axis] = layer;
        places.array[at + u] = i + (corner === 1 || corner === 2 ? w : 0);
        places.array[at + v] = j + (corner >= 2 ? h : 0);
        places.array[at + 3] = flags | open[corner] << 11;
    }
    // The diagonal joins the corners that are alike, or the shade would show a crease.
    const turn = open[0] + open[2] < open[1] + open[3] ? 1 : 0;
    const order = side ? [0, 1, 2, 0, 2, 3] : [0, 2, 1, 0, 3, 2];
    const to = indices.take(6);
    for (let k = 0; k < 6; k++) indices.array[to + k] = base + ((order[k] + turn) & 3);
}

/**
 * The first voxel that a ray meets: its bordered index, its three indices, or null. `from` and `along` are in voxels, the
 * corner of the first one being 0, 0, 0.
 */
function meet(shown, size, from, along) {
    let [enter, leave] = [0, Infinity];
    for (let a = 0; a < 3; a++) {
        const [p, q] = [-from[a] / along[a], (size[a] - from[a]) / along[a]];
        if (along[a] === 0) {
            if (from[a] < 0 || from[a] > size[a]) return null;
        } else {
            enter = Math.max(enter, Math.min(p, q));
            leave = Math.min(leave, Math.max(p, q));
        }
    }
    if (!(enter < leave)) return null;
    const step = strides(size);
    const cell = [0, 1, 2].map((a) => {
        return Math.min(Math.max(Math.floor(from[a] + along[a] * (enter + 1e-6)), 0), size[a] - 1);
    });
    const next = [0, 1, 2].map((a) => {
        return along[a] === 0 ? Infinity : (cell[a] + (along[a] > 0 ? 1 : 0) - from[a]) / along[a];
    });
    for (;;) {
        const at = cell.reduce((sum, c, a) => sum + (c + 1) * step[a], 0);
        if (shown[at]) return { at, cell };
        const a = next[0] <= next[1] && next[0] <= next[2] ? 0 : next[1] <= next[2] ? 1 : 2;
        cell[a] += along[a] > 0 ? 1 : -1;
        if (cell[a] < 0 || cell[a] >= size[a]) return null;
        next[a] += Math.abs(1 / along[a]);
    }
}

