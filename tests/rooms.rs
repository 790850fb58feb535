//! No two files of the library use each other, directly or around. A file and those in its own folder are one thing.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

/// A module's path, from the crate's root.
type Name = Vec<String>;

/// What a file says of others.
#[derive(Default)]
struct File {
    /// Absolute paths of what it uses.
    uses: Vec<Name>,
    /// What it makes known under its own name, and where that is.
    known: BTreeMap<String, Name>,
}

fn words(path: &str) -> Name {
    path.split("::").map(|word| word.trim().to_owned()).filter(|word| !word.is_empty()).collect()
}

/// Every source file by the module that it is, without tests.
fn sources(directory: &Path, module: &Name, found: &mut BTreeMap<Name, String>) {
    for entry in std::fs::read_dir(directory).unwrap() {
        let path = entry.unwrap().path();
        let stem = path.file_stem().unwrap().to_str().unwrap().to_owned();
        let mut name = module.clone();
        if path.is_dir() {
            name.push(stem);
            sources(&path, &name, found);
        } else if path.extension().is_some_and(|e| e == "rs") && stem != "tests" && stem != "main" {
            if stem != "mod" && stem != "lib" {
                name.push(stem);
            }
            found.insert(name, std::fs::read_to_string(&path).unwrap());
        }
    }
}

/// The paths of a `use` tree.
fn leaves(tree: &str, prefix: &Name, found: &mut Vec<Name>) {
    let (mut depth, mut start) = (0, 0);
    let ends = tree.char_indices().chain([(tree.len(), ',')]);
    for (i, c) in ends {
        match c {
            '{' => depth += 1,
            '}' => depth -= 1,
            ',' if depth == 0 => {
                let part = &tree[start..i];
                start = i + 1;
                match part.split_once('{') {
                    Some((head, rest)) => {
                        let inner = rest.trim_end().strip_suffix('}').expect("a closed brace");
                        leaves(inner, &[prefix.clone(), words(head)].concat(), found);
                    }
                    None => {
                        let path = words(part.split(" as ").next().unwrap());
                        if !path.is_empty() {
                            found.push([prefix.clone(), path].concat());
                        }
                    }
                }
            }
            _ => {}
        }
    }
}

/// The path from the crate's root, unless it leads to another crate.
fn absolute(path: &[String], module: &Name, modules: &BTreeSet<Name>) -> Option<Name> {
    match path[0].as_str() {
        "crate" => Some(path[1..].to_vec()),
        "self" => Some([module, &path[1..]].concat()),
        "super" => {
            let ups = path.iter().take_while(|word| *word == "super").count();
            Some([&module[..module.len() - ups], &path[ups..]].concat())
        }
        _ => {
            let child = [&module[..], &path[..1]].concat();
            modules.contains(&child).then(|| [&module[..], path].concat())
        }
    }
}

/// Reads a file up to the tests in it.
fn read(text: &str, module: &Name, modules: &BTreeSet<Name>) -> File {
    let text = text.split("#[cfg(test)]\nmod tests {").next().unwrap();
    let text: String = text.lines().map(|line| line.split("//").next().unwrap()).collect::<Vec<_>>().join("\n");
    let mut file = File::default();
    // `use` trees, and paths that stand in code.
    for (i, _) in text.match_indices("use ") {
        let line = text[..i].rfind('\n').map_or(0, |n| n + 1);
        let before = text[line..i].trim();
        if !before.is_empty() && !before.starts_with("pub") {
            continue;
        }
        let tree = text[i + 4..].split(';').next().unwrap();
        let mut paths = vec![];
        leaves(tree, &vec![], &mut paths);
        for path in paths.iter().filter_map(|path| absolute(path, module, modules)) {
            if before.starts_with("pub") {
                file.known.insert(path.last().unwrap().clone(), path.clone());
            }
            file.uses.push(path);
        }
    }
    for root in ["crate::", "super::"] {
        for (i, _) in text.match_indices(root) {
            let end = text[i..].find(|c: char| !c.is_alphanumeric() && c != '_' && c != ':').unwrap_or(text.len() - i);
            let path = words(&text[i..i + end]);
            if path.len() > 1 {
                file.uses.extend(absolute(&path, module, modules));
            }
        }
    }
    file
}

/// The file that has what `path` names, wherever it was made known besides.
fn home(path: &Name, files: &BTreeMap<Name, File>) -> Name {
    let mut path = path.clone();
    for _ in 0..10 {
        let module = (0..=path.len()).rev().map(|n| path[..n].to_vec()).find(|m| files.contains_key(m)).unwrap();
        let known = path.get(module.len()).and_then(|word| files[&module].known.get(word));
        match known {
            Some(place) => path = [&place[..], &path[module.len() + 1..]].concat(),
            None => return module,
        }
    }
    panic!("{} is known under too many names", path.join("::"));
}

/// For each file, the others that it uses.
fn edges(sources: &BTreeMap<Name, String>) -> BTreeMap<Name, BTreeSet<Name>> {
    let modules: BTreeSet<Name> = sources.keys().cloned().collect();
    let files: BTreeMap<Name, File> =
        sources.iter().map(|(module, text)| (module.clone(), read(text, module, &modules))).collect();
    let apart = |a: &Name, b: &Name| !a.starts_with(b) && !b.starts_with(a);
    let used = |module: &Name, file: &File| {
        file.uses.iter().map(|path| home(path, &files)).filter(|other| apart(module, other)).collect()
    };
    files.iter().map(|(module, file)| (module.clone(), used(module, file))).collect()
}

/// Files that use each other, from one around to itself.
fn cycle(edges: &BTreeMap<Name, BTreeSet<Name>>) -> Option<Vec<String>> {
    /// Whether a file leads to itself by way of `trail`; `clear` are those that do not.
    fn walk(
        file: &Name,
        edges: &BTreeMap<Name, BTreeSet<Name>>,
        trail: &mut Vec<Name>,
        clear: &mut BTreeSet<Name>,
    ) -> bool {
        if clear.contains(file) {
            return false;
        }
        let seen = trail.contains(file);
        trail.push(file.clone());
        if seen || edges[file].iter().any(|other| walk(other, edges, trail, clear)) {
            return true;
        }
        trail.pop();
        clear.insert(file.clone());
        false
    }
    let mut clear = BTreeSet::new();
    edges.keys().find_map(|file| {
        let mut trail = vec![];
        walk(file, edges, &mut trail, &mut clear).then(|| trail.iter().map(|name| name.join("::")).collect())
    })
}

#[test]
fn no_two_files_use_each_other() {
    let mut found = BTreeMap::new();
    sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &vec![], &mut found);
    let edges = edges(&found);
    let uses: usize = edges.values().map(BTreeSet::len).sum();
    assert!(edges.len() > 100 && uses > 300, "{} files, {uses} uses", edges.len());
    assert_eq!(cycle(&edges), None);
}

#[test]
fn rooms_lie_one_above_the_other() {
    let mut found = BTreeMap::new();
    sources(&Path::new(env!("CARGO_MANIFEST_DIR")).join("src"), &vec![], &mut found);
    let mut rooms: BTreeMap<Name, BTreeSet<Name>> = BTreeMap::new();
    for (file, used) in edges(&found).iter().filter(|(file, _)| !file.is_empty()) {
        let room = &file[..1];
        let others = used.iter().map(|other| other[..1].to_vec()).filter(|other| *other != room);
        rooms.entry(room.to_vec()).or_default().extend(others);
    }
    assert!(rooms.len() > 10, "{rooms:?}");
    assert_eq!(cycle(&rooms), None);
}

#[test]
fn a_cycle_is_found_directly_around_and_behind_other_names() {
    let found = |files: &[(&str, &str)]| {
        let sources = files.iter().map(|(name, text)| (words(name), (*text).to_owned()));
        let mut sources: BTreeMap<Name, String> = sources.collect();
        sources.insert(vec![], String::new());
        cycle(&edges(&sources))
    };
    assert_eq!(found(&[("a", "use crate::b::X;"), ("b", "use std::fmt;")]), None);
    assert!(found(&[("a", "use crate::b::X;"), ("b", "use super::a::{self, Y};")]).is_some());
    assert!(
        found(&[("a", "fn f() { crate::b::g() }"), ("b", "use crate::c::{X, d::Y};"), ("c", "use crate::a;")])
            .is_some()
    );
    // What a folder's file makes known lies where it lies.
    let room = [("r", "pub use x::X; mod x;"), ("r::x", "use crate::b::B;")];
    assert!(found(&[&room[..], &[("b", "use crate::r::X;")]].concat()).is_some());
    assert_eq!(
        found(&[&room[..], &[("b", "// use crate::r::X;\n#[cfg(test)]\nmod tests {use crate::r::X;}")]].concat()),
        None
    );
    // A folder's files may use what it has itself.
    assert_eq!(found(&[("r", "use x::X; pub struct R;"), ("r::x", "use super::R;")]), None);
}
