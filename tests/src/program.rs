//! Runs `daic` and `hil-sim` as a user would.

use crate::shared::root;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::OnceLock;

fn target_directory() -> PathBuf {
    let mut path = std::env::current_exe().expect("a test knows its own path");
    path.pop(); // deps
    path.pop();
    path
}

/// Path of a program of the workspace, as `cargo test --workspace` builds it.
///
/// Cargo is asked to bring it up to date; within `cargo test --workspace` there is nothing to do.
pub fn program(name: &str) -> PathBuf {
    static BUILT: OnceLock<()> = OnceLock::new();
    let directory = target_directory();
    BUILT.get_or_init(|| {
        let mut build = Command::new(std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into()));
        // the same command, so the same features: anything else would build the dependencies anew
        build.args(["test", "--workspace", "--no-run", "--quiet", "--locked"]);
        if directory.ends_with("release") {
            build.arg("--release");
        }
        build.arg("--target-dir").arg(directory.parent().expect("target/<profile>"));
        build.current_dir(root());
        let status = build.status().expect("cargo starts");
        assert!(status.success(), "building the programs: {status}");
    });
    directory.join(name)
}

/// What a run of `daic` gave.
pub struct Run {
    /// Exit code; `None` when ended by a signal.
    pub code: Option<i32>,
    /// Standard output.
    pub stdout: String,
    /// Standard error.
    pub stderr: String,
}

impl Run {
    fn of(output: Output) -> Self {
        Self {
            code: output.status.code(),
            stdout: String::from_utf8_lossy(&output.stdout).into_owned(),
            stderr: String::from_utf8_lossy(&output.stderr).into_owned(),
        }
    }

    /// The one JSON object on standard output.
    ///
    /// # Panics
    /// If there is anything else on it.
    pub fn json(&self) -> serde_json::Value {
        let value: serde_json::Value = serde_json::from_str(&self.stdout).unwrap_or_else(|error| {
            panic!("stdout is not one JSON value ({error}):\n{}\n{}", self.stdout, self.stderr)
        });
        assert!(value.is_object(), "stdout is not a JSON object: {}", self.stdout);
        value
    }

    /// Fails the test, showing everything, unless the run ended with `code`.
    #[track_caller]
    pub fn expect_code(self, code: i32) -> Self {
        assert_eq!(self.code, Some(code), "stdout:\n{}\nstderr:\n{}", self.stdout, self.stderr);
        self
    }
}

/// Runs `daic` with `arguments` in `directory`.
pub fn daic<I, S>(directory: &Path, arguments: I) -> Run
where
    I: IntoIterator<Item = S>,
    S: AsRef<std::ffi::OsStr>,
{
    let output =
        Command::new(program("daic")).args(arguments).current_dir(directory).output().expect("daic starts");
    Run::of(output)
}
