//! Progress on stderr, one answer on stdout.

use daic::{Error, Progress};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};
use serde_json::{Value, json};
use std::sync::atomic::AtomicBool;
use std::sync::{Arc, Mutex};

/// Where a command reports to.
pub struct Output {
    json: bool,
    bar: ProgressBar,
    stage: Mutex<String>,
    stop: Arc<AtomicBool>,
    /// With a terminal the bar shows the stages; without one each gets a line.
    lines: bool,
}

/// What a command found: the JSON object and the same for people.
pub struct Answer {
    json: Value,
    text: String,
    passed: bool,
}

impl Answer {
    /// An answer of a command that did what it was asked to.
    pub fn new(json: Value, text: impl Into<String>) -> Self {
        Self { json, text: text.into(), passed: true }
    }

    /// Adds to the text for people.
    pub fn with_note(mut self, note: &str) -> Self {
        self.text.push_str(note);
        self
    }

    /// Marks the answer of a check: a check that did not hold exits with 1.
    pub fn checked(mut self, passed: bool) -> Self {
        self.passed = passed;
        self
    }

    pub fn exit_code(&self) -> u8 {
        u8::from(!self.passed)
    }
}

impl Output {
    pub fn new(json: bool, quiet: bool) -> Self {
        use std::io::IsTerminal as _;
        let terminal = std::io::stderr().is_terminal();
        let target = if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr() };
        let bar = ProgressBar::with_draw_target(None, target);
        if let Ok(style) = ProgressStyle::with_template("{msg:32} {wide_bar} {pos}/{len} {elapsed}") {
            bar.set_style(style);
        }
        Self { json, bar, stage: Mutex::default(), stop: Arc::default(), lines: !quiet && !terminal }
    }

    pub fn is_json(&self) -> bool {
        self.json
    }

    /// Errors are drawn with the source line underlined, without colour where nobody can see it.
    pub fn install_error_style(&self) {
        // a second installation in one process is refused and harmless
        miette::set_hook(Box::new(|_| {
            Box::new(miette::MietteHandlerOpts::new().width(100).context_lines(1).build())
        }))
        .ok();
    }

    /// Ctrl-C stops a rig or a series of images in an orderly way; a second one ends the program at once.
    pub fn stop_on_interrupt(&self) {
        #[cfg(unix)]
        for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
            // in this order: the first interrupt finds the flag still down
            let armed = Arc::clone(&self.stop);
            signal_hook::flag::register_conditional_shutdown(signal, 130, armed).ok();
            signal_hook::flag::register(signal, Arc::clone(&self.stop)).ok();
        }
    }

    /// A line on stderr, for what cannot wait for the answer.
    pub fn note(&self, line: &str) {
        if !self.bar.is_hidden() || self.lines {
            self.bar.suspend(|| eprintln!("{line}"));
        }
    }

    pub fn answer(&self, answer: &Answer) {
        self.bar.finish_and_clear();
        let text = if self.json { answer.json.to_string() } else { answer.text.clone() };
        print_line(text.trim_end());
    }

    pub fn error(&self, error: &Error) {
        self.bar.finish_and_clear();
        if self.json {
            print_line(&json!({ "error": error.to_string(), "exit_code": error.exit_code() }).to_string());
        }
        eprintln!("{:?}", miette::Report::new(diagnostic::Drawn::of(error)));
    }
}

/// Prints a line; a reader who has gone (`| head`) has what it wanted.
pub fn print_line(text: &str) {
    use std::io::Write as _;
    writeln!(std::io::stdout(), "{text}").ok();
}

impl Progress for Output {
    fn stage(&self, name: &str, total: u64) {
        if let Ok(mut stage) = self.stage.lock() {
            if self.lines && *stage != name {
                eprintln!("{name}");
            }
            name.clone_into(&mut stage);
        }
        self.bar.set_length(total);
        self.bar.set_position(0);
        self.bar.set_message(name.to_owned());
    }

    fn advance(&self, done: u64) {
        self.bar.set_position(done);
    }

    fn stop_requested(&self) -> &AtomicBool {
        &self.stop
    }
}

/// An error as miette draws it: for files with the line underlined, else one paragraph.
mod diagnostic {
    use daic_rig::experiment::ConfigError;
    use miette::{Diagnostic, LabeledSpan, NamedSource, SourceCode};
    use std::fmt;

    #[derive(Debug)]
    pub struct Drawn {
        message: String,
        help: Option<String>,
        source: Option<NamedSource<String>>,
        labels: Vec<LabeledSpan>,
    }

    impl Drawn {
        pub fn of(error: &daic::Error) -> Self {
            let Some(ConfigError::Invalid { path, text, problems }) = error.config() else {
                return Self { message: error.to_string(), help: None, source: None, labels: Vec::new() };
            };
            let labels = problems
                .iter()
                .map(|p| LabeledSpan::new_with_span(Some(p.message.clone()), p.span.clone()))
                .collect();
            let help: Vec<&str> = problems.iter().filter_map(|p| p.help.as_deref()).collect();
            Self {
                message: error.to_string(),
                help: (!help.is_empty()).then(|| help.join("\n")),
                source: Some(NamedSource::new(path.display().to_string(), text.clone())),
                labels,
            }
        }
    }

    impl fmt::Display for Drawn {
        fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            f.write_str(&self.message)
        }
    }

    impl std::error::Error for Drawn {}

    impl Diagnostic for Drawn {
        fn help<'a>(&'a self) -> Option<Box<dyn fmt::Display + 'a>> {
            self.help.as_ref().map(|h| Box::new(h) as _)
        }
        fn source_code(&self) -> Option<&dyn SourceCode> {
            self.source.as_ref().map(|s| s as _)
        }
        fn labels(&self) -> Option<Box<dyn Iterator<Item = LabeledSpan> + '_>> {
            (!self.labels.is_empty()).then(|| Box::new(self.labels.iter().cloned()) as _)
        }
    }
}
