//! Which part of a data set this process is to do: said, or found out from the engine that started it.

use std::str::FromStr;
use voxcast::eval::Shard;
use voxcast::{Error, Result};

/// `--shard`.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ShardArgument {
    /// This one.
    Of(Shard),
    /// The one that the engine's variables say.
    Auto,
}

impl FromStr for ShardArgument {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self> {
        if text == "auto" { Ok(Self::Auto) } else { text.parse().map(Self::Of) }
    }
}

impl ShardArgument {
    /// The shard. `variable` looks up variables of the environment.
    ///
    /// # Errors
    /// For `auto`, if there are no variables of a known engine, or they make no sense.
    pub fn resolve(&self, variable: &dyn Fn(&str) -> Option<String>) -> Result<Shard> {
        match self {
            Self::Of(shard) => Ok(*shard),
            Self::Auto if variable("SLURM_ARRAY_TASK_ID").is_some() => slurm(variable),
            Self::Auto if variable("JOB_COMPLETION_INDEX").is_some() => kubernetes(variable),
            Self::Auto => Err(Error::mismatch(
                "--shard auto: neither SLURM_ARRAY_TASK_ID nor JOB_COMPLETION_INDEX is set, expected a Slurm array or a \
                 Kubernetes Indexed Job, or --shard I/N",
            )),
        }
    }
}

/// A task of a Slurm array. Arrays may start at any number and go in steps.
fn slurm(variable: &dyn Fn(&str) -> Option<String>) -> Result<Shard> {
    let [task, first, last, count] =
        ["ID", "MIN", "MAX", "COUNT"].map(|name| number(&format!("SLURM_ARRAY_TASK_{name}"), variable));
    let (task, first, last, count) = (task?, first?, last?, count?);
    let step = match variable("SLURM_ARRAY_TASK_STEP") {
        Some(_) => number("SLURM_ARRAY_TASK_STEP", variable)?.max(1),
        None => 1,
    };
    // With gaps, a task's number does not say how many are before it.
    let whole = task >= first && count > 0 && (count - 1).checked_mul(step) == last.checked_sub(first);
    if !whole || (task - first) % step != 0 {
        let message = format!(
            "--shard auto: task {task} of a Slurm array of {count} from {first} to {last} in steps of {step}, expected \
             one without gaps, or --shard I/N"
        );
        return Err(Error::mismatch(message));
    }
    Shard::new((task - first) / step, count)
}

/// A pod of an Indexed Job, which Kubernetes tells its index only.
fn kubernetes(variable: &dyn Fn(&str) -> Option<String>) -> Result<Shard> {
    Shard::new(number("JOB_COMPLETION_INDEX", variable)?, number("JOB_COMPLETIONS", variable)?)
}

fn number(name: &str, variable: &dyn Fn(&str) -> Option<String>) -> Result<usize> {
    let found =
        variable(name).ok_or_else(|| Error::mismatch(format!("--shard auto: {name} is not set, expected a number")))?;
    let message = || Error::mismatch(format!("--shard auto: {name} is {found:?}, expected a number"));
    found.parse().map_err(|_| message())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn auto(variables: &[(&str, &str)]) -> std::result::Result<String, String> {
        let variable = |name: &str| {
            let found = variables.iter().find(|(known, _)| *known == name);
            found.map(|(_, value)| (*value).to_owned())
        };
        ShardArgument::Auto.resolve(&variable).map(|shard| shard.to_string()).map_err(|e| e.to_string())
    }

    fn slurm_array<'a>(
        id: &'a str,
        min: &'a str,
        max: &'a str,
        count: &'a str,
        step: &'a str,
    ) -> [(&'a str, &'a str); 5] {
        [
            ("SLURM_ARRAY_TASK_ID", id),
            ("SLURM_ARRAY_TASK_MIN", min),
            ("SLURM_ARRAY_TASK_MAX", max),
            ("SLURM_ARRAY_TASK_COUNT", count),
            ("SLURM_ARRAY_TASK_STEP", step),
        ]
    }

    #[test]
    fn engines_say_which() {
        assert_eq!(auto(&slurm_array("0", "0", "7", "8", "1")).as_deref(), Ok("0/8"));
        assert_eq!(auto(&slurm_array("8", "1", "8", "8", "1")).as_deref(), Ok("7/8"));
        assert_eq!(auto(&slurm_array("14", "10", "18", "5", "2")).as_deref(), Ok("2/5"));
        assert_eq!(auto(&slurm_array("8", "1", "8", "8", "1")[..4]).as_deref(), Ok("7/8"));
        assert_eq!(auto(&[("JOB_COMPLETION_INDEX", "3"), ("JOB_COMPLETIONS", "4")]).as_deref(), Ok("3/4"));
    }

    #[test]
    fn what_says_nothing_is_refused() {
        for (variables, expected) in [
            (&[][..], "neither SLURM_ARRAY_TASK_ID"),
            (&slurm_array("3", "1", "7", "3", "1"), "3 from 1 to 7 in steps of 1, expected one without gaps"),
            (&slurm_array("3", "2", "6", "3", "2"), "without gaps"),
            (&slurm_array("x", "1", "7", "3", "1"), "SLURM_ARRAY_TASK_ID is \"x\""),
            (&slurm_array("0", "0", "7", "8", "1")[..1], "SLURM_ARRAY_TASK_MIN is not set, expected a number"),
            (&slurm_array("0", "0", "7", "8", "1")[..3], "SLURM_ARRAY_TASK_COUNT is not set"),
            (&slurm_array("0", "0", "7", "8", "1")[1..], "neither SLURM_ARRAY_TASK_ID nor"),
            (&[("JOB_COMPLETION_INDEX", "3")], "JOB_COMPLETIONS is not set"),
            (&[("JOB_COMPLETIONS", "3")], "nor JOB_COMPLETION_INDEX is set"),
            (&[("JOB_COMPLETION_INDEX", ""), ("JOB_COMPLETIONS", "4")], "JOB_COMPLETION_INDEX is \"\""),
            (&[("JOB_COMPLETION_INDEX", "4"), ("JOB_COMPLETIONS", "4")], "shard 4/4"),
        ] {
            let error = auto(variables).expect_err(expected);
            assert!(error.contains(expected), "{error} does not say {expected:?}");
        }
        assert_eq!("auto".parse::<ShardArgument>().expect("a word"), ShardArgument::Auto);
        assert!("some".parse::<ShardArgument>().is_err());
    }
}
