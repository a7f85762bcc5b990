//! The eleven steps in their order, and how far a record has come: what `daic align guide` says.

use super::record::read_record;
use crate::camera_file::CameraFile;
use crate::error::Error;
use serde::Serialize;
use std::path::Path;

/// How a step stands.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum State {
    /// Done, and within two standard deviations of aligned where it aligns anything.
    Done,
    /// Measured; its advice has not been followed yet, or not been checked.
    Correct,
    /// Not done.
    ToDo,
    /// Done by hand: a later step in the record shows that it is done.
    ByHand,
}

impl State {
    /// Mark in front of a step.
    pub const fn mark(self) -> &'static str {
        match self {
            Self::Done => "done   ",
            Self::Correct => "correct",
            Self::ToDo => "to do  ",
            Self::ByHand => "by hand",
        }
    }
}

/// One of the eleven steps.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct GuideStep {
    /// From 1, as in the literature.
    pub number: u8,
    /// What is done.
    pub what: &'static str,
    /// The command that measures it; none for what hands alone do.
    pub command: Option<&'static str>,
    /// How it stands.
    pub state: State,
    /// When it was measured, UTC.
    pub date: Option<String>,
    /// What the measurement says is to be done.
    pub advice: Vec<String>,
}

/// Where a step's state comes from.
enum Source {
    /// The camera file.
    Camera,
    /// A table of the record.
    Record(&'static str),
    /// Field `second` of the table of the orders.
    SecondGrating,
    /// No image shows it; done once the named table is there.
    Hands(&'static str),
    /// The last step.
    Measure,
}

struct Plan {
    what: &'static str,
    command: Option<&'static str>,
    source: Source,
}

const PLAN: [Plan; 11] = [
    Plan {
        what: "calibrate the camera",
        command: Some("daic calibrate camera IMAGE… --pitch MM --board dots --out DIR"),
        source: Source::Camera,
    },
    Plan {
        what: "camera along the rail: an aperture on it, near and far, comes out at the principal point",
        command: Some(
            "daic align watch aperture FOLDER, then daic align rail NEAR FAR --distances MM,MM --record FILE",
        ),
        source: Source::Record("rail"),
    },
    Plan {
        what: "laser along the camera's axis: its spot on a card, near and far",
        command: Some(
            "daic align watch laser FOLDER, then daic align laser NEAR FAR --distances MM,MM --record FILE",
        ),
        source: Source::Record("laser"),
    },
    Plan {
        what: "gratings onto the rail, the beam through one of them: the reflected spot goes back into the aperture",
        command: Some(
            "daic align reflection APERTURE SPOT --pinhole-to-aperture MM --grating-to-aperture MM --record FILE",
        ),
        source: Source::Record("reflection"),
    },
    Plan {
        what: "gratings close to the camera: the spots of orders −1, 0, +1 along the x axis",
        command: Some("daic align watch orders FOLDER, then daic align orders IMAGE --record FILE"),
        source: Source::Record("orders"),
    },
    Plan {
        what: "the beam through the other grating: the same",
        command: Some("daic align orders IMAGE OTHER --record FILE"),
        source: Source::SecondGrating,
    },
    Plan {
        what: "gratings off the rail, with their carrier",
        command: None,
        source: Source::Hands("distance"),
    },
    Plan {
        what: "calibration board where the specimen will be, in focus: D = L F/L′",
        command: Some(
            "daic align distance IMAGE --board dots --pitch MM,SIGMA --grating-to-board MM,SIGMA --record FILE",
        ),
        source: Source::Record("distance"),
    },
    Plan {
        what: "gratings back onto the rail; the beam through them shows whether they stand as before",
        command: Some("daic align orders IMAGE OTHER --again --record FILE"),
        source: Source::Record("orders_again"),
    },
    Plan {
        what: "d from gratings to board with a caliper, s = D − d, into the optics file",
        command: Some("daic align distance … --optics IN --out OUT: the step above with the optics file"),
        source: Source::Record("distance"),
    },
    Plan {
        what: "board away, a test surface in its place: measure it",
        command: Some(
            "daic profile --optics OUT FRAME --out DIR (a flat one: the gap should be noise alone)",
        ),
        source: Source::Measure,
    },
];

fn entry(record: &toml::Table, name: &str) -> (State, Option<String>, Vec<String>) {
    let Some(step) = record.get(name).and_then(toml::Value::as_table) else {
        return (State::ToDo, None, Vec::new());
    };
    let aligned = step.get("aligned").and_then(toml::Value::as_bool).unwrap_or(false);
    let date = step.get("date").and_then(toml::Value::as_str).map(str::to_owned);
    let advice = step.get("advice").and_then(toml::Value::as_array);
    let advice = advice.into_iter().flatten().filter_map(|a| Some(a.as_str()?.to_owned())).collect();
    (if aligned { State::Done } else { State::Correct }, date, advice)
}

/// The steps with what camera file and record say of each; what does not exist yet is to do.
///
/// # Errors
/// A camera file or a record that is there and cannot be read.
pub fn guide(camera: &Path, record: Option<&Path>) -> Result<Vec<GuideStep>, Error> {
    let camera = if camera.exists() { Some(CameraFile::load(camera)?) } else { None };
    let record = record.map(read_record).transpose()?.unwrap_or_default();
    let second = record.get("orders").and_then(|o| o.get("found")).and_then(|f| f.get("second")).is_some();
    let steps = PLAN.iter().zip(1..).map(|(plan, number)| {
        let (state, date, advice) = match plan.source {
            Source::Camera => match &camera {
                Some(file) => (State::Done, Some(file.date.clone()), Vec::new()),
                None => (State::ToDo, None, Vec::new()),
            },
            Source::Record(name) => entry(&record, name),
            Source::SecondGrating if second => entry(&record, "orders"),
            Source::Hands(shown_by) if record.contains_key(shown_by) => (State::ByHand, None, Vec::new()),
            Source::SecondGrating | Source::Hands(_) | Source::Measure => (State::ToDo, None, Vec::new()),
        };
        GuideStep { number, what: plan.what, command: plan.command, state, date, advice }
    });
    Ok(steps.collect())
}
