//! The page's geometry against plain definitions, in the browser that will run it.

use serde_json::json;
use std::path::Path;
use voxcast_viewer::{Browser, DESK};

const MESH: &str = include_str!("../../../src/show/html/mesh.js");

/// Random grids of solid voxels and ghosts, and helpers.
const SETUP: &str = "
    let seed = 7;
    const random = () => (seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0) / 2 ** 32;
    function grid(size, filled) {
        const shown = new Uint16Array((size[0] + 2) * (size[1] + 2) * (size[2] + 2));
        const step = strides(size);
        for (let x = 1; x <= size[0]; x++) for (let y = 1; y <= size[1]; y++) for (let z = 1; z <= size[2]; z++) {
            if (random() < filled) {
                const ghost = random() < 0.3 ? GHOST : 0;
                shown[x * step[0] + y * step[1] + z] = ghost && random() < 0.3 ? GHOST : ghost | 1 + Math.floor(random() * 3);
            }
        }
        return shown;
    }
";

fn browser() -> Browser {
    let browser = Browser::start(DESK);
    let directory = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let path = directory.path().join("empty.html");
    std::fs::write(&path, "<!doctype html><body data-ready='true'>").unwrap();
    browser.open(Path::new(&path));
    browser
}

/// Every unit face that should be there is covered once, by a rectangle of its group, and no other is.
#[test]
fn rectangles_cover_exactly_the_faces() {
    let wrong = browser().run(&format!(
        "{MESH} {SETUP}
        const wrong = [];
        for (const [size, filled] of [[[1, 1, 1], 1], [[5, 4, 3], 0.5], [[9, 7, 6], 0.2], [[8, 9, 10], 0.9], [[6, 6, 6], 1], [[3, 4, 5], 0]]) {{
            const shown = grid(size, filled);
            const step = strides(size);
            const faces = new Map();
            for (let x = 0; x < size[0]; x++) for (let y = 0; y < size[1]; y++) for (let z = 0; z < size[2]; z++) {{
                const at = (x + 1) * step[0] + (y + 1) * step[1] + z + 1;
                for (let side = 0; side < 6; side++) {{
                    const front = shown[at + (side & 1 ? 1 : -1) * step[side >> 1]];
                    const voxel = shown[at];
                    if (voxel && (front === 0 || (voxel < GHOST && front >= GHOST))) faces.set([x, y, z, side].join(), voxel);
                }}
            }}
            const {{ places, indices }} = mesh(shown, size);
            if (indices.length / 6 !== places.length / 16) wrong.push('lengths');
            for (let quad = 0; quad < places.length / 16; quad++) {{
                const corner = (k) => [...places.subarray(16 * quad + 4 * k, 16 * quad + 4 * k + 4)];
                const [a, b] = [corner(0), corner(2)];
                const side = a[3] >> 8 & 7;
                const axis = side >> 1;
                const voxel = (a[3] & 255) | (a[3] >> 13 & 1 ? GHOST : 0);
                const ends = b.map((v, k) => (k === axis ? v + 1 : v));
                for (let x = a[0]; x < ends[0]; x++) for (let y = a[1]; y < ends[1]; y++) for (let z = a[2]; z < ends[2]; z++) {{
                    const cell = [x, y, z];
                    cell[axis] -= side & 1;
                    const key = [...cell, side].join();
                    if (faces.get(key) !== voxel) wrong.push(key + ' of ' + size);
                    faces.delete(key);
                }}
                // Both triangles turn anticlockwise as seen from outside.
                for (const t of [0, 3]) {{
                    const [p, q, r] = [0, 1, 2].map((k) => places.subarray(4 * indices[6 * quad + t + k], 4 * indices[6 * quad + t + k] + 3));
                    const [u, v] = [(axis + 1) % 3, (axis + 2) % 3];
                    const area = (q[u] - p[u]) * (r[v] - p[v]) - (q[v] - p[v]) * (r[u] - p[u]);
                    if (side & 1 ? area <= 0 : area >= 0) wrong.push('winding ' + side);
                }}
            }}
            if (faces.size) wrong.push(faces.size + ' faces left of ' + size);
        }}
        return wrong.slice(0, 5);"
    ));
    assert_eq!(wrong, json!([]));
}

/// A wall of one class is one rectangle a side, and a voxel before it darkens the corners around it.
#[test]
fn equal_faces_are_joined_and_corners_are_dark() {
    let found = browser().run(&format!(
        "{MESH}
        const size = [4, 5, 6];
        const step = strides(size);
        const shown = new Uint16Array(6 * 7 * 8);
        for (let x = 1; x <= 4; x++) for (let y = 1; y <= 5; y++) for (let z = 1; z <= 2; z++) shown[x * step[0] + y * step[1] + z] = 2;
        const wall = mesh(shown, size).indices.length / 6;
        shown[2 * step[0] + 2 * step[1] + 3] = 1;
        const {{ places }} = mesh(shown, size);
        // The corner that the top of the wall shares with the voxel (1, 1, 2), which stands on it, and one far from it.
        const openness = new Set();
        let far = 0;
        for (let at = 0; at < places.length; at += 4) {{
            const [x, y, z, flags] = places.subarray(at, at + 4);
            if ((flags >> 8 & 7) !== 5 || z !== 2) continue;
            if (x === 1 && y === 1) openness.add(flags >> 11 & 3);
            if (x === 4 && y === 5) far = flags >> 11 & 3;
        }}
        return [wall, [...openness].sort(), far];"
    ));
    // Beside the voxel's two sides one voxel stands at the corner, and so it does diagonally: 2 everywhere.
    assert_eq!(found, json!([6, [2], 3]));
}

/// The voxel that a ray meets is the first shown one of all that it passes through.
#[test]
fn rays_meet_the_first_voxel() {
    let wrong = browser().run(&format!(
        "{MESH} {SETUP}
        const wrong = [];
        let hits = 0;
        for (let n = 0; n < 400; n++) {{
            const size = [7, 5, 6];
            const shown = grid(size, 0.08);
            const from = [0, 1, 2].map(() => random() * 20 - 7);
            const to = [0, 1, 2].map((k) => random() * size[k]);
            const along = n % 10 === 0 ? [0, 0, -1] : to.map((v, k) => v - from[k]);
            const found = meet(shown, size, n % 10 === 0 ? [to[0], to[1], 9] : from, along);
            // The nearest entry of all boxes that the ray crosses.
            const start = n % 10 === 0 ? [to[0], to[1], 9] : from;
            const step = strides(size);
            let best = [Infinity, null];
            for (let x = 0; x < size[0]; x++) for (let y = 0; y < size[1]; y++) for (let z = 0; z < size[2]; z++) {{
                if (!shown[(x + 1) * step[0] + (y + 1) * step[1] + z + 1]) continue;
                let [enter, leave] = [0, Infinity];
                [x, y, z].forEach((v, k) => {{
                    const [p, q] = [(v - start[k]) / along[k], (v + 1 - start[k]) / along[k]];
                    if (along[k] === 0) {{ if (start[k] < v || start[k] > v + 1) leave = -1; return; }}
                    enter = Math.max(enter, Math.min(p, q));
                    leave = Math.min(leave, Math.max(p, q));
                }});
                if (enter + 1e-9 < leave && enter < best[0]) best = [enter, [x, y, z].join()];
            }}
            if (best[1]) hits++;
            if ((found ? found.cell.join() : null) !== best[1]) wrong.push([n, found && found.cell.join(), best[1]]);
        }}
        return hits > 100 ? wrong : ['only ' + hits + ' hits'];"
    ));
    assert_eq!(wrong, json!([]));
}
