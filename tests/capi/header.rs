//! `include/voxcast.h` as the tests read it.

/// The header's text without comments.
fn code() -> String {
    let mut rest = include_str!("../../include/voxcast.h");
    let mut code = String::new();
    while let Some((before, after)) = rest.split_once("/*") {
        code += before;
        rest = after.split_once("*/").expect("comments end").1;
    }
    code + rest
}

/// Functions that are declared, sorted.
pub(crate) fn functions() -> Vec<String> {
    let mut names: Vec<String> = code()
        .split(';')
        .filter_map(|declaration| declaration.split_once('('))
        .filter_map(|(before, _)| before.split(|c: char| !(c.is_alphanumeric() || c == '_')).next_back())
        .filter(|name| name.starts_with("voxcast_"))
        .map(str::to_owned)
        .collect();
    names.sort();
    names
}

/// Constants of the enumerations, in order.
pub(crate) fn constants() -> Vec<(String, i32)> {
    let code = code();
    let bodies = code.split("enum {").skip(1).map(|rest| rest.split_once('}').expect("enumerations end").0);
    bodies
        .flat_map(|body| body.split(','))
        .map(|constant| {
            let (name, value) = constant.split_once('=').expect("every constant has a value");
            (name.trim().to_owned(), value.trim().parse().expect("a number"))
        })
        .collect()
}

/// Numbers that are defined as macros.
pub(crate) fn defined(name: &str) -> u32 {
    let code = code();
    let mut lines = code.lines().filter_map(|line| line.strip_prefix("#define ")?.strip_prefix(name));
    lines.find_map(|value| value.trim().parse().ok()).unwrap_or_else(|| panic!("{name} is not defined"))
}

/// Structs and their fields, in order.
pub(crate) fn structs() -> Vec<(String, Vec<String>)> {
    let code = code();
    let bodies =
        code.split("typedef struct ").skip(1).filter_map(|rest| rest.split_once('{').zip(rest.split_once('}')));
    bodies
        // A struct of no body is a handle; what follows it up to the next brace is not its own.
        .filter(|((name, _), _)| !name.contains(';'))
        .map(|((name, _), (body, _))| {
            let fields = body.split_once('{').expect("split there before").1.split(';').map(str::trim);
            let fields = fields.filter(|field| !field.is_empty()).map(|field| {
                let declared = field.split('[').next().unwrap_or(field);
                declared.rsplit([' ', '*']).next().unwrap_or(declared).to_owned()
            });
            (name.trim().to_owned(), fields.collect())
        })
        .collect()
}
