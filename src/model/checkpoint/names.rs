//! Names of tensors: what wrappers put into them, and which are like one that is missing.

use std::collections::BTreeMap;

/// Segments that wrappers put in front of every name of what they wrap: `DataParallel` and moving averages, `torch.compile`,
/// and modules that hold the network as their `model`.
const FRONT: [&str; 3] = ["module", "_orig_mod", "model"];

/// The name without what wrappers put in front, and without `_orig_mod` wherever a part was compiled by itself.
fn unwrapped(name: &str) -> String {
    let mut rest = name;
    while let Some((segment, after)) = rest.split_once('.').filter(|(s, after)| FRONT.contains(s) && !after.is_empty())
    {
        debug_assert!(!segment.is_empty());
        rest = after;
    }
    rest.split('.').filter(|&segment| segment != "_orig_mod").collect::<Vec<_>>().join(".")
}

/// Replaces each name by what it is without wrappers, unless the file has another tensor for that name: then both keep
/// theirs. Says how many were replaced.
pub(super) fn unwrap_all(names: BTreeMap<String, usize>) -> (BTreeMap<String, usize>, usize) {
    let mut count: BTreeMap<String, usize> = BTreeMap::new();
    for name in names.keys() {
        *count.entry(unwrapped(name)).or_default() += 1;
    }
    let mut replaced = 0;
    let rename = |(name, index): (String, usize)| {
        let short = unwrapped(&name);
        if short == name || count[&short] > 1 {
            return (name, index);
        }
        replaced += 1;
        (short, index)
    };
    let names = names.into_iter().map(rename).collect();
    (names, replaced)
}

/// Up to three of `names` that are most like `name`: that end alike, else that begin alike, segment by segment.
pub(super) fn nearest<'a>(name: &str, names: impl Iterator<Item = &'a str>) -> Vec<&'a str> {
    let wanted: Vec<&str> = name.split('.').collect();
    let likeness = |other: &str| {
        let other: Vec<&str> = other.split('.').collect();
        let end = wanted.iter().rev().zip(other.iter().rev()).take_while(|(a, b)| a == b).count();
        let begin = wanted.iter().zip(&other).take_while(|(a, b)| a == b).count();
        // A name that ends in "weight" is like every other weight.
        if end > 1 || begin > 0 { 2 * end + begin } else { 0 }
    };
    let mut ranked: Vec<_> =
        names.map(|other| (likeness(other), other)).filter(|&(likeness, _)| likeness > 0).collect();
    // The sort is stable: names that are equally like stay in their order.
    ranked.sort_by_key(|&(likeness, _)| std::cmp::Reverse(likeness));
    ranked.into_iter().take(3).map(|(_, other)| other).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn after(names: &[&str]) -> Vec<String> {
        let names = names.iter().enumerate().map(|(i, name)| ((*name).to_owned(), i)).collect();
        unwrap_all(names).0.into_keys().collect()
    }

    #[test]
    fn wrappers_are_taken_off_name_by_name() {
        for (names, expected) in [
            (&["a.w", "b"][..], &["a.w", "b"][..]),
            (&["module.b", "module.a.w"], &["a.w", "b"]),
            (&["module.b", "steps"], &["b", "steps"]),
            (&["module.b", "n_averaged", "module.a"], &["a", "b", "n_averaged"]),
            (&["_orig_mod.b", "_orig_mod.a"], &["a", "b"]),
            (&["module._orig_mod.b"], &["b"]),
            (&["model.b", "model.a", "epoch"], &["a", "b", "epoch"]),
            (&["model.module._orig_mod.neck.w"], &["neck.w"]),
            (&["neck._orig_mod.w", "head.w"], &["head.w", "neck.w"]),
            // Two tensors for one name: which one is meant, nobody knows.
            (&["module.b", "b"], &["b", "module.b"]),
            (&["module.b", "model.b"], &["model.b", "module.b"]),
            (&["module.b", "b", "module.c"], &["b", "c", "module.b"]),
            // What only looks like one.
            (&["module", "model.", "modules.b", "my.module.b"], &["model.", "module", "modules.b", "my.module.b"]),
        ] {
            assert_eq!(after(names), expected, "{names:?}");
        }
    }

    #[test]
    fn the_nearest_names_end_or_begin_alike() {
        let names =
            ["backbone.conv1.weight", "backbone.layer1.0.conv1.weight", "head.0.bias", "neck.convs.0.conv.weight"];
        let near = |name| nearest(name, names.into_iter());
        assert_eq!(near("img_backbone.conv1.weight"), ["backbone.conv1.weight", "backbone.layer1.0.conv1.weight"]);
        assert_eq!(near("neck.convs.0.conv.bias"), ["neck.convs.0.conv.weight"]);
        assert_eq!(near("img_neck.fpn_convs.0.conv.weight"), ["neck.convs.0.conv.weight"]);
        assert!(near("other.bias").is_empty());
        assert_eq!(nearest("a.w", (0..9).map(|_| "b.a.w")).len(), 3);
    }
}
