//! `daic rig`: the trigger box by itself.

use super::commands::as_json;
use super::output::{Answer, Output};
use clap::{Args, Subcommand, ValueEnum};
use daic::box_program::{encode, read, read_instructions};
use daic::expand::{self, Waits};
use daic::exposure::{self, Exposures, Stated};
use daic::recording::event_record;
use daic::{Error, Progress as _, stage, timeline};
use daic_dataset::{Existing, atomic};
use daic_protocol::limits::TICK_HZ;
use daic_protocol::message::{Autostart, Event, EventKind, SelfTests, State, Status};
use daic_protocol::program::Instruction;
use daic_rig::RigError;
use daic_rig::experiment::Experiment;
use daic_rig::link::{EventReader, Link, LinkOptions, StreamSender, Unrolled};
use daic_rig::units::Length;
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

/// Where the box is unless something else is said.
const DEFAULT_PORT: &str = "/dev/ttyACM0";
/// Between two looks at the box.
const POLL: Duration = Duration::from_millis(10);

#[derive(Debug, Args)]
pub struct RigArgs {
    /// Serial port or tcp://HOST:PORT of the trigger box [default: /dev/ttyACM0, or what the experiment says]
    #[arg(long, global = true)]
    pub port: Option<String>,
    /// Bits per second of a serial port
    #[arg(long, global = true, default_value_t = 115_200)]
    pub baud: u32,
    #[command(subcommand)]
    pub command: RigCommand,
}

#[derive(Debug, Subcommand)]
pub enum RigCommand {
    #[command(flatten)]
    Box(BoxCommand),
    /// Find steps per millimetre, direction and backlash of an axis from what the camera sees
    CalibrateStage(StageArgs),
    /// Measure delay and length of exposures on the camera's exposure-active line
    CalibrateExposure(ExposureArgs),
}

/// What needs nothing but the box.
#[derive(Debug, Subcommand)]
pub enum BoxCommand {
    /// What the box is, its state, its inputs, its slots
    Info,
    /// Load a program (experiment .toml, instructions .json, or encoded)
    Load { program: PathBuf },
    /// Play the program that is loaded, or load and play one, and wait for its end
    Run { program: Option<PathBuf> },
    /// Play a program of any length while it is sent
    Stream { program: PathBuf },
    /// Print events as they come, until interrupted
    Watch,
    /// Print the events that the box still keeps
    Events {
        /// First event wanted
        #[arg(long, default_value_t = 0)]
        from: u32,
    },
    /// Find the home switches of axes
    Home {
        /// Axis numbers
        #[arg(required = true)]
        axes: Vec<u8>,
    },
    /// Move one axis
    Move {
        axis: u8,
        /// Absolute target in steps
        #[arg(allow_hyphen_values = true)]
        target: i32,
        /// Steps per second
        #[arg(long, default_value_t = 8000)]
        rate: u32,
        /// Steps per second squared
        #[arg(long, default_value_t = 80_000)]
        acceleration: u32,
        /// Steps per second cubed; 0 does not limit it
        #[arg(long, default_value_t = 0)]
        jerk: u32,
    },
    /// Keep the loaded program, or FILE, in a slot of the box
    Store {
        slot: u8,
        program: Option<PathBuf>,
        /// Start it at power-up
        #[arg(long, conflicts_with = "on_input")]
        on_power_up: bool,
        /// Start it at a rising edge of this trigger input
        #[arg(long, value_name = "INPUT")]
        on_input: Option<u8>,
        /// Forget what the slot holds
        #[arg(long, conflicts_with_all = ["program", "on_power_up", "on_input"])]
        erase: bool,
    },
    /// Let the box test itself
    Selftest,
    /// Draw a program as a timing diagram (.svg, .html or .vcd), alone or against what was played
    Timeline {
        program: PathBuf,
        /// File to write
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
        /// Play it first and draw what was played, and the difference
        #[arg(long)]
        play: bool,
    },
}

#[derive(Debug, Clone, Copy, ValueEnum)]
pub enum AxisArg {
    X,
    Y,
    Z,
}

#[derive(Debug, Args)]
pub struct StageArgs {
    /// Experiment that describes rig and optics; its sequence is not played
    pub experiment: PathBuf,
    /// Axis to calibrate
    #[arg(long)]
    pub axis: AxisArg,
    /// Folder for the dataset; the result is in results/stage.json
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Replace a dataset that is there
    #[arg(long)]
    pub replace: bool,
    /// From the lowest to the highest position; a quarter of it is needed beyond either end
    #[arg(long, default_value = "400 um")]
    pub travel: Length,
    /// Middle of the positions
    #[arg(long, default_value = "0 mm", allow_hyphen_values = true)]
    pub centre: Length,
    /// Positions on the way
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(2..=1000))]
    pub positions: u32,
    /// How often up and down
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(1..=100))]
    pub passes: u32,
    /// Optics that are known otherwise than from moves of this stage (default: the experiment's own)
    #[arg(long, value_name = "FILE")]
    pub optics: Option<PathBuf>,
    /// Folder of the camera's frames (default: the experiment's)
    #[arg(long, value_name = "DIR")]
    pub frames: Option<PathBuf>,
    /// Scene of the simulated rig, where the experiment's port is `sim`
    #[arg(long, value_name = "FILE")]
    pub scene: Option<PathBuf>,
}

#[derive(Debug, Args)]
pub struct ExposureArgs {
    /// Experiment that describes the camera; its sequence is not played
    pub experiment: PathBuf,
    /// Exposures to measure
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub triggers: u32,
}

fn calibrate_exposure(
    arguments: &ExposureArgs,
    port: Option<&String>,
    output: &Output,
) -> Result<Answer, Error> {
    let experiment = Experiment::load(&arguments.experiment)?;
    let port = port.unwrap_or(&experiment.rig.port);
    let mut link = rig(Link::open(port, daic::recording::link_options(&experiment)))?;
    let stated = Stated::of(&experiment, link.hello().tick_hz);
    let program = exposure::program(&experiment, link.hello(), arguments.triggers).map_err(RigError::from)?;
    rig(link.load(&encode(&program)?))?;
    let events: Vec<_> = play_loaded(&mut link, output)?.iter().map(event_record).collect();
    let found = Exposures::of(&events, stated.line).summary(&stated);
    let found = found.ok_or(Error::NoExposures { line: stated.line, triggers: arguments.triggers })?;
    let mut text = format!(
        "{} exposures after {} triggers, {} missing, {} unasked\n",
        found.exposures, arguments.triggers, found.missing, found.unasked
    );
    let times = [
        ("delay", found.delay_us, found.stated_delay_us),
        ("length", found.length_us, found.stated_length_us),
    ];
    for (name, times, stated) in times {
        let Some(t) = times else { continue };
        writeln!(
            text,
            "{name:<7} {:.3} µs, jitter {:.3} µs ({:.3} to {:.3}), the experiment says {stated:.3} µs",
            t.mean, t.std, t.min, t.max
        )
        .ok();
    }
    if let Some(delay) = found.delay_us {
        write!(text, "in the experiment, under [rig.camera]:\nexposure_delay = \"{:.3} us\"", delay.mean)
            .ok();
    }
    let whole = found.missing == 0 && found.unasked == 0 && found.exposures == arguments.triggers as usize;
    Ok(Answer::new(as_json(&found)?, text).checked(whole))
}

fn calibrate_stage(arguments: &StageArgs, port: Option<&String>, output: &Output) -> Result<Answer, Error> {
    let experiment = Experiment::load(&arguments.experiment)?;
    output.stop_on_interrupt();
    let options = stage::Options {
        axis: arguments.axis as usize,
        travel: arguments.travel,
        centre: arguments.centre,
        positions: arguments.positions,
        passes: arguments.passes,
        optics: arguments.optics.clone(),
        out: arguments.out.clone(),
        existing: if arguments.replace { Existing::Replace } else { Existing::Refuse },
        port: port.cloned(),
        frames: arguments.frames.clone(),
        scene: arguments.scene.clone(),
    };
    let found = stage::calibrate(&experiment, &options, output)?;
    let mut text = String::new();
    let calibration = found.steps_per_mm_sigma_cal.map_or(String::new(), |s| format!(" (optics ± {s:.3})"));
    writeln!(
        text,
        "steps per mm    {:.3} ± {:.3}{calibration}, the experiment says {}",
        found.steps_per_mm, found.steps_per_mm_sigma, found.steps_per_mm_before
    )
    .ok();
    writeln!(text, "backlash        {:.3} ± {:.3} µm", found.backlash_um, found.backlash_sigma_um).ok();
    let [x, y, h] = found.direction;
    writeln!(text, "direction       ({x:.5}, {y:.5}, {h:.5}), {:.3}° off {}", found.angle_deg, found.axis)
        .ok();
    if let Some([up, down]) = found.repeatability_um {
        writeln!(text, "repeatability   {up:.3} µm counting up, {down:.3} µm counting down").ok();
    }
    writeln!(text, "residual        {:.3} µm RMS over {} frames", found.rms_um, found.frames).ok();
    let approach = as_json(&found.approach)?;
    let backlash = found.backlash_um.max(0.0);
    write!(
        text,
        "in the experiment:\n[rig.axes.{}]\nsteps_per_mm = {:.3}\nbacklash = \"{backlash:.3} um\"\napproach = {approach}",
        found.axis, found.steps_per_mm
    )
    .ok();
    Ok(Answer::new(as_json(&found)?, text))
}

fn rig<T>(result: Result<T, daic_rig::link::LinkError>) -> Result<T, Error> {
    Ok(result.map_err(RigError::from)?)
}

pub fn run(arguments: &RigArgs, output: &Output) -> Result<Answer, Error> {
    match &arguments.command {
        RigCommand::CalibrateStage(stage) => calibrate_stage(stage, arguments.port.as_ref(), output),
        RigCommand::CalibrateExposure(exposure) => {
            calibrate_exposure(exposure, arguments.port.as_ref(), output)
        }
        RigCommand::Box(BoxCommand::Timeline { program, out, play: false })
            if program.extension().is_none_or(|e| e != "toml") =>
        {
            draw_plan(out, &read_instructions(program)?, [0; 6])
        }
        RigCommand::Box(command) => {
            let options = LinkOptions { baud: arguments.baud, ..LinkOptions::default() };
            let port = arguments.port.as_deref().unwrap_or(DEFAULT_PORT);
            with_box(command, &mut rig(Link::open(port, options))?, output)
        }
    }
}

fn with_box(command: &BoxCommand, link: &mut Link, output: &Output) -> Result<Answer, Error> {
    match command {
        BoxCommand::Info => info(link),
        BoxCommand::Load { program } => {
            let hash = load(link, program)?;
            Ok(Answer::new(json!({ "program": hash }), format!("loaded, hash {hash:#010x}")))
        }
        BoxCommand::Run { program } => {
            if let Some(program) = program {
                load(link, program)?;
            }
            let events = play_loaded(link, output)?;
            played_answer(&events)
        }
        BoxCommand::Stream { program } => stream(link, program, output),
        BoxCommand::Watch => watch(link, output),
        BoxCommand::Events { from } => {
            let mut events = Vec::new();
            rig(EventReader::new(*from).poll(link, &mut events))?;
            Ok(Answer::new(json!({ "events": records(&events)? }), lines(&events)))
        }
        BoxCommand::Home { axes } => {
            let program: Vec<_> = axes.iter().map(|&axis| Instruction::Home { axis }).collect();
            play(link, &program, output)
        }
        BoxCommand::Move { axis, target, rate, acceleration, jerk } => {
            let (axis, target) = (*axis, *target);
            let go =
                Instruction::Move { axis, target, max_rate: *rate, acceleration: *acceleration, jerk: *jerk };
            play(link, &[go], output)
        }
        BoxCommand::Store { slot, program, on_power_up, on_input, erase } => {
            if *erase {
                rig(link.erase(*slot))?;
                return Ok(Answer::new(
                    json!({ "slot": slot, "erased": true }),
                    format!("slot {slot} is empty"),
                ));
            }
            if let Some(program) = program {
                load(link, program)?;
            }
            let autostart = match (on_power_up, on_input) {
                (true, _) => Autostart::PowerUp,
                (false, Some(input)) => Autostart::Input { input: *input },
                (false, None) => Autostart::Off,
            };
            rig(link.store(*slot, autostart))?;
            let slots = as_json(&rig(link.slots())?)?;
            Ok(Answer::new(json!({ "slots": slots }), format!("stored in slot {slot}")))
        }
        BoxCommand::Selftest => self_test(link),
        BoxCommand::Timeline { program, out, play } => {
            let instructions = read(program, link)?;
            let position = rig(link.status())?.position;
            if !play {
                return draw_plan(out, &instructions, position);
            }
            rig(link.load(&encode(&instructions)?))?;
            let events = play_loaded(link, output)?;
            let begin =
                events.iter().find(|e| matches!(e.kind, EventKind::RunStarted { .. })).map_or(0, |e| e.tick);
            let played = timeline::played(&events, begin);
            let waits = timeline::answers(&events, begin);
            let planned = expand::expand_with(&instructions, position, Waits::Ended(&waits))?;
            draw(out, &timeline::without_axes(&planned), Some(&played))
        }
    }
}

fn load(link: &mut Link, path: &std::path::Path) -> Result<u32, Error> {
    let instructions = read(path, link)?;
    rig(link.load(&encode(&instructions)?))
}

fn play(link: &mut Link, program: &[Instruction], output: &Output) -> Result<Answer, Error> {
    rig(link.load(&encode(program)?))?;
    let events = play_loaded(link, output)?;
    played_answer(&events)
}

fn info(link: &mut Link) -> Result<Answer, Error> {
    let status = rig(link.status())?;
    let inputs = rig(link.inputs())?;
    let slots = rig(link.slots())?;
    let hello = link.hello().clone();
    let mut text = format!(
        "{} firmware {} (protocol {}), boot {:#010x}\nstate {:?}, program {}, run {}\n",
        hello.board,
        hello.firmware,
        hello.protocol,
        hello.boot_id,
        status.state,
        status.program.map_or("none".to_owned(), |hash| format!("{hash:#010x}")),
        status.run
    );
    if let Some(fault) = status.fault {
        writeln!(text, "fault: {:?} at tick {}, instruction {}", fault.cause, fault.tick, fault.instruction)
            .ok();
    }
    for (axis, position) in status.position.iter().enumerate().take(usize::from(hello.axes)) {
        let homed = if inputs.homed >> axis & 1 == 1 { "" } else { " (not homed)" };
        writeln!(text, "axis {axis}: {position} steps{homed}").ok();
    }
    for input in 0..usize::from(hello.inputs) {
        let level = inputs.word >> input & 1;
        writeln!(
            text,
            "input {input}: {level}, {} rising edges, {} missed",
            inputs.rising[input], inputs.missed[input]
        )
        .ok();
    }
    for slot in &slots {
        writeln!(
            text,
            "slot {}: {} bytes, hash {:#010x}, {:?}",
            slot.slot, slot.length, slot.hash, slot.autostart
        )
        .ok();
    }
    let json = json!({
        "hello": as_json(&hello)?,
        "status": as_json(&status)?,
        "inputs": as_json(&inputs)?,
        "slots": as_json(&slots)?,
    });
    Ok(Answer::new(json, text))
}

/// Arms, starts, reads events to the end of the run.
fn play_loaded(link: &mut Link, output: &Output) -> Result<Vec<Event>, Error> {
    let status = rig(link.status())?;
    let Some(hash) = status.program else { return Err(RigError::NotReady { state: status.state }.into()) };
    clear_fault(link, &status, output)?;
    rig(link.arm(hash))?;
    output.stop_on_interrupt();
    output.stage("playing", 0);
    rig(link.start())?;
    follow(link, status.next_event, output, &mut |_| Ok(()))
}

/// Reads events until the run ends; `each` is called between two looks. A box that cannot be followed any more is not
/// left playing.
fn follow(
    link: &mut Link,
    from: u32,
    output: &Output,
    each: &mut dyn FnMut(&mut Link) -> Result<(), Error>,
) -> Result<Vec<Event>, Error> {
    let followed = follow_on(link, from, output, each);
    if followed.as_ref().is_err_and(|e| !matches!(e, Error::Rig(RigError::BoxFaulted { .. })))
        && let Err(error) = link.abort()
    {
        output.note(&format!("the box could not be told to stop: {error}"));
    }
    followed
}

fn follow_on(
    link: &mut Link,
    from: u32,
    output: &Output,
    each: &mut dyn FnMut(&mut Link) -> Result<(), Error>,
) -> Result<Vec<Event>, Error> {
    let mut reader = EventReader::new(from);
    let mut events = Vec::new();
    let (mut stopped, mut refused) = (false, None);
    loop {
        let before = events.len();
        rig(reader.poll(link, &mut events))?;
        for event in events.get(before..).unwrap_or(&[]) {
            match event.kind {
                EventKind::RunDone { .. } => return Ok(events),
                EventKind::Faulted { cause, instruction } => {
                    return Err(RigError::BoxFaulted { cause, tick: event.tick, instruction }.into());
                }
                _ => {}
            }
        }
        if let Some(refused) = refused {
            return Err(refused);
        }
        if output.stop_requested().load(Ordering::Relaxed) && !stopped {
            rig(link.stop())?;
            stopped = true;
        }
        // A run that has just ended takes nothing any more; its last event says why.
        refused = each(link).err();
        std::thread::sleep(POLL);
    }
}

/// Makes a box that has faulted before ready again, and says what of.
fn clear_fault(link: &mut Link, status: &Status, output: &Output) -> Result<(), Error> {
    if status.state == State::Faulted {
        rig(link.clear_fault())?;
        if let Some(fault) = status.fault {
            let (cause, tick) = (fault.cause, fault.tick);
            output.note(&format!(
                "cleared the fault {cause:?} of tick {tick}, instruction {}",
                fault.instruction
            ));
        }
    }
    Ok(())
}

fn stream(link: &mut Link, path: &std::path::Path, output: &Output) -> Result<Answer, Error> {
    let instructions = read(path, link)?;
    // the box takes no loops in streams
    let count = Unrolled::count(&instructions);
    let status = rig(link.status())?;
    clear_fault(link, &status, output)?;
    output.stop_on_interrupt();
    output.stage("streaming", count);
    let mut sender = rig(StreamSender::begin(link, Unrolled::new(&instructions)))?;
    rig(link.start())?;
    let mut last = sender.state();
    let events = follow(link, status.next_event, output, &mut |link| {
        if !last.ended {
            rig(sender.fill(link))?;
            last = sender.state();
            output.advance(u64::from(last.instruction));
        }
        Ok(())
    })?;
    let lead = events.iter().find_map(|e| match e.kind {
        EventKind::StreamLead { ticks } if ticks != u64::MAX => Some(ticks as f64 * 1e3 / f64::from(TICK_HZ)),
        _ => None,
    });
    let text = lead
        .map_or("played; it fitted the memory".to_owned(), |ms| format!("played; smallest lead {ms:.3} ms"));
    Ok(Answer::new(json!({ "instructions": count, "min_lead_ms": lead, "events": events.len() }), text))
}

fn watch(link: &mut Link, output: &Output) -> Result<Answer, Error> {
    output.stop_on_interrupt();
    let mut reader = EventReader::new(rig(link.status())?.next_event);
    let mut count = 0;
    let begin = Instant::now();
    while !output.stop_requested().load(Ordering::Relaxed) {
        let mut events = Vec::new();
        rig(reader.poll(link, &mut events))?;
        // With --json the answer is the only object on stdout.
        for event in events.iter().filter(|_| !output.is_json()) {
            super::output::print_line(&line(event));
        }
        count += events.len();
        std::thread::sleep(POLL);
    }
    let seconds = begin.elapsed().as_secs_f64();
    Ok(Answer::new(
        json!({ "events": count, "seconds": seconds }),
        format!("{count} events in {seconds:.1} s"),
    ))
}

fn self_test(link: &mut Link) -> Result<Answer, Error> {
    let found = rig(link.self_test())?;
    let names = [
        (SelfTests::CRC, "CRC"),
        (SelfTests::PROGRAM, "program in memory"),
        (SelfTests::MOTION, "step times"),
        (SelfTests::VERIFIER, "verifier"),
        (SelfTests::FRAMING, "framing"),
        (SelfTests::OUTPUTS, "outputs safe"),
    ];
    let mut text = String::new();
    for (bit, name) in names.into_iter().filter(|(bit, _)| found.made & bit != 0) {
        let verdict = if found.failed & bit == 0 { "ok" } else { "FAILED" };
        writeln!(text, "{name}: {verdict}").ok();
    }
    for bit in (16..32).filter(|bit| found.made >> bit & 1 == 1) {
        let verdict = if found.failed >> bit & 1 == 0 { "ok" } else { "FAILED" };
        writeln!(text, "board test {}: {verdict}", bit - 16).ok();
    }
    Ok(Answer::new(as_json(&found)?, text).checked(found.failed == 0))
}

/// Draws a program that has not been played: what it waits for comes at once.
fn draw_plan(out: &std::path::Path, program: &[Instruction], position: [i32; 6]) -> Result<Answer, Error> {
    let planned = expand::expand_with(program, position, Waits::AtOnce)?;
    let answer = draw(out, &planned, None)?;
    let waits = program.iter().any(|i| matches!(i, Instruction::Wait { .. }));
    let note = ", drawn as if every trigger came as soon as something waits for it";
    Ok(if waits { answer.with_note(note) } else { answer })
}

fn draw(
    out: &std::path::Path,
    planned: &timeline::Words,
    played: Option<&timeline::Words>,
) -> Result<Answer, Error> {
    let found = played.map(|played| timeline::difference(planned, played));
    let mut traces = vec![("planned", "#06c", planned)];
    let mut scopes = vec![("planned", planned)];
    if let Some(played) = played {
        traces.push(("played", "#c30", played));
        scopes.push(("played", played));
    }
    let spans = found.as_ref().map_or(&[][..], |d| &d.spans);
    let text = match out.extension().and_then(|e| e.to_str()) {
        Some("svg") => timeline::svg(&traces, spans),
        Some("html") => timeline::html("Timeline", &traces, found.as_ref()),
        Some("vcd") => timeline::vcd(&scopes),
        _ => return Err(Error::UnknownFormat { path: out.to_owned(), allowed: ".svg, .html, .vcd" }),
    };
    atomic::write_bytes(out, text.as_bytes())?;
    let same = found.as_ref().is_none_or(timeline::Difference::is_none);
    let verdict = match &found {
        None => String::new(),
        Some(d) if d.is_none() => ", played as planned to the tick".to_owned(),
        Some(d) => format!(", DIFFERENT from change {} on", d.first.map_or(0, |f| f.0)),
    };
    let json = json!({
        "file": out.display().to_string(),
        "planned": planned.len(),
        "difference": found.as_ref().map(as_json).transpose()?,
    });
    Ok(Answer::new(json, format!("{}: {} changes{verdict}", out.display(), planned.len())).checked(same))
}

fn played_answer(events: &[Event]) -> Result<Answer, Error> {
    let words = events.iter().find_map(|e| match e.kind {
        EventKind::RunDone { words, .. } => Some(words),
        _ => None,
    });
    let text = format!("played: {} words, {} events", words.unwrap_or(0), events.len());
    Ok(Answer::new(json!({ "words": words, "events": records(events)? }), text))
}

fn records(events: &[Event]) -> Result<Value, Error> {
    as_json(&events.iter().map(event_record).collect::<Vec<_>>())
}

fn line(event: &Event) -> String {
    format!("{:>8} {:>16} {:?}", event.seq, event.tick, event.kind)
}

fn lines(events: &[Event]) -> String {
    events.iter().map(line).collect::<Vec<_>>().join("\n")
}
