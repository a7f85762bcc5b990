//! Requests in, replies out; the state machine.

use crate::Sink;
use crate::board::{Board, PLAYED};
use crate::loader::Loader;
use crate::outputs::{AXES, LEDS, Outputs};
use crate::player::{Player, Progress, Stage, trigger_edges, unhomed};
use crate::replies::{Replies, Seen};
use crate::self_test;
use crate::stream::Source;
use crate::verifier::{Checker, Choice, violation};
use daic_protocol::channels::{EXPOSURE_MASK, INTERLOCK, LIMIT_MASK};
use daic_protocol::frame::{Decoder, Fed, FrameBytes, TooLarge, encode_reply};
use daic_protocol::limits::*;
use daic_protocol::message::*;
use daic_protocol::program::{ProgramBytes, decode};

/// At the end of a run, camera triggers at least so old that had no exposure are told as missing (1 ms).
const EXPOSURE_GRACE: u64 = 125_000;

/// The controller.
#[derive(Debug)]
pub struct Controller {
    board: Board,
    boot_id: u32,
    decoder: Decoder,
    replies: Replies,
    loader: Loader,
    out: Outputs,
    state: State,
    fault: Option<Fault>,
    /// Number of the last run begun.
    run: u32,
    /// `Some` while running; the flag tells whether `RunStarted` has been reported.
    player: Option<(Player, bool)>,
    /// First tick of the run.
    start: u64,
    /// When the host was last heard.
    host: u64,
    /// The host's silence has been noticed: what it says comes too late.
    host_lost: bool,
    now: u64,
    /// How far the last stream had come when it ended.
    last_stream: Option<StreamState>,
    /// Words up to this tick are out of hand.
    horizon: u64,
    health: Health,
}

impl Controller {
    /// A controller just booted: outputs safe, all levels 0, no program, all axes at step 0.
    pub fn new(board: Board, boot_id: u32) -> Self {
        Self {
            out: Outputs::new(&board),
            board,
            boot_id,
            decoder: Decoder::new(),
            replies: Replies::new(),
            loader: Loader::new(),
            state: State::Empty,
            fault: None,
            run: 0,
            player: None,
            start: 0,
            host: 0,
            host_lost: false,
            now: 0,
            last_stream: None,
            horizon: 0,
            health: Health::default(),
        }
    }

    /// State now.
    pub fn state(&self) -> State {
        self.state
    }

    /// The board.
    pub fn board(&self) -> &Board {
        &self.board
    }

    /// Latest tick the controller was told of.
    pub fn now(&self) -> u64 {
        self.now
    }

    /// Position of each axis: steps made since boot, positive minus negative.
    pub fn position(&self) -> [i32; AXES] {
        self.out.position()
    }

    /// Word that stands on the outputs.
    pub fn word(&self) -> u32 {
        self.out.word
    }

    /// Level of each LED.
    pub fn levels(&self) -> [u16; LEDS] {
        self.out.levels()
    }

    /// Number of the last run begun since boot, 0 before the first.
    pub fn run(&self) -> u32 {
        self.run
    }

    /// The fault, if the state is [`State::Faulted`].
    pub fn fault(&self) -> Option<Fault> {
        self.fault
    }

    /// Sequence number the next event will have.
    pub fn next_event(&self) -> u32 {
        self.out.log.next()
    }

    /// One past the highest sequence number of an event ever put into a reply.
    pub fn events_read(&self) -> u32 {
        self.out.log.read_end()
    }

    /// Hash of the committed program.
    pub fn program(&self) -> Option<u32> {
        self.loader.hash()
    }

    /// How far the stream is that has been begun, if there is one.
    pub fn stream(&self) -> Option<StreamState> {
        let played = if self.player.is_some() { self.played() } else { 0 };
        self.loader.stream().map(|stream| stream.state(played))
    }

    /// Frames rejected since boot, by cause.
    pub fn rejected(&self) -> Rejected {
        self.decoder.rejected
    }

    /// Takes bytes received by tick `now`; every reply frame goes to `reply`.
    ///
    /// What is due by `now` is played first, so that `Stop` and `Abort` find the outputs as they
    /// are. Ticks never run backwards: an earlier `now` than before only counts for `Clock`.
    pub fn receive(&mut self, now: u64, bytes: &[u8], sink: &mut dyn Sink, reply: &mut dyn FnMut(&[u8])) {
        for &byte in bytes {
            if let Fed::Message { id, crc, message } = self.decoder.feed_request(byte) {
                self.play(now, sink);
                if !self.host_lost {
                    self.host = self.host.max(now);
                }
                self.answer(now, id, crc, &message, sink, reply);
            }
        }
    }

    /// The link was opened anew: forget a frame that has begun. Counters and replies stay.
    pub fn link_restarted(&mut self) {
        self.decoder.restart();
    }

    /// Plays everything due up to and including tick `until`; inputs have not changed up to then.
    pub fn play(&mut self, until: u64, sink: &mut dyn Sink) {
        self.play_ahead(until, until, sink);
    }

    /// Plays everything due up to and including tick `until`, where inputs have not changed up to and
    /// including tick `known`. A board whose player in hardware is filled in advance plays ahead of what it
    /// knows of its inputs; it must tell of inputs within `Board::input_latency`.
    pub fn play_ahead(&mut self, until: u64, known: u64, sink: &mut dyn Sink) {
        self.now = self.now.max(known);
        self.out.inputs.known = self.out.inputs.known.max(known);
        let Some((player, begun)) = &mut self.player else { return };
        if !*begun {
            if self.start > until {
                return;
            }
            *begun = true;
            (self.out.words, self.out.events) = (0, 0);
            let program = self.loader.stream().map(|s| s.hash()).or(self.loader.hash()).unwrap_or(0);
            self.out.note(self.start, EventKind::RunStarted { run: self.run, program });
        }
        // What a player in hardware has been given cannot be taken back: the silence counts from there on.
        if self.horizon > 0
            && !self.host_lost
            && let Some(deadline) = player.silence_ends(self.host).filter(|d| *d <= self.now)
        {
            self.host = self.host.saturating_add(self.horizon.saturating_sub(deadline));
            self.host_lost = true;
        }
        let mut stage = Stage { board: &self.board, out: &mut self.out, sink, host: self.host, blind: false };
        let progress = player.play(until, known, self.loader.source(), &mut stage);
        self.conclude(progress, sink);
    }

    /// A player in hardware has been given everything before `tick`: `Stop` ends the run with the
    /// instruction that is current then.
    pub fn committed(&mut self, tick: u64) {
        self.horizon = self.horizon.max(tick);
    }

    /// A player in hardware needs the next instruction of a stream now: what comes later comes too late.
    pub fn seal_stream(&mut self) {
        self.loader.seal_stream();
    }

    /// The outputs have gone safe at `tick` without being told to; a run that is under way ends.
    pub fn trip(&mut self, cause: FaultCause, tick: u64, sink: &mut dyn Sink) {
        if self.player.is_none() {
            return;
        }
        // What came out until then has happened.
        let before = tick.saturating_sub(1);
        if let Some((player, begun)) = &mut self.player
            && (*begun || self.start <= before)
        {
            if !*begun {
                *begun = true;
                (self.out.words, self.out.events) = (0, 0);
                let program = self.loader.stream().map(|s| s.hash()).or(self.loader.hash()).unwrap_or(0);
                self.out.note(self.start, EventKind::RunStarted { run: self.run, program });
            }
            let mut stage =
                Stage { board: &self.board, out: &mut self.out, sink, host: self.host, blind: true };
            let known = self.now.min(before);
            if let Progress::Ended(tick) = player.play(before, known, self.loader.source(), &mut stage) {
                return self.end(tick, sink);
            }
        }
        self.fail(cause, tick.max(self.out.last()), sink);
    }

    /// Outputs are to go safe at `tick`, or as soon after it as the board can.
    fn halt(&mut self, cause: FaultCause, tick: u64, sink: &mut dyn Sink) {
        let halted = sink.halt(tick);
        if halted > tick { self.trip(cause, halted, sink) } else { self.fail(cause, tick, sink) }
    }

    /// What the board tells about itself in `Health`.
    pub fn set_health(&mut self, health: Health) {
        self.health = health;
    }

    pub(crate) fn cursor(&self) -> Option<(&Player, &Outputs)> {
        self.player.as_ref().map(|(player, _)| (player, &self.out))
    }

    pub(crate) fn source_ahead(&self) -> Source<'_> {
        self.loader.source_ahead()
    }

    /// When the host was last heard, for one who reads ahead: as long as it is not lost, just now.
    pub(crate) fn host_ahead(&self) -> u64 {
        if self.host_lost { self.host } else { u64::MAX }
    }

    pub(crate) fn stop_from(&self) -> Option<u64> {
        self.player.as_ref().and_then(|(player, _)| player.stop_from())
    }

    fn conclude(&mut self, progress: Progress, sink: &mut dyn Sink) {
        match progress {
            Progress::Waiting | Progress::Later(_) => {}
            Progress::Ended(tick) => self.end(tick, sink),
            Progress::Failed(cause, tick) => {
                let tick = self.out.earliest_safe(tick.max(self.out.last()));
                self.halt(cause, tick, sink);
            }
            Progress::Broken => {
                let tick = self.out.earliest_safe(self.out.last());
                self.halt(FaultCause::Internal, tick, sink);
            }
        }
    }

    /// The input word (see [`channels`](daic_protocol::channels)) is `word` from tick `tick` on. Changes come
    /// in order of ticks. Everything due by then is played first.
    pub fn inputs(&mut self, tick: u64, word: u32, sink: &mut dyn Sink) {
        // An output due at the tick of the change comes before it; a trigger that comes at the last tick of
        // a wait still counts.
        let tick = tick.max(self.out.inputs.known);
        self.play_ahead(tick, tick.saturating_sub(1), sink);
        let before = self.out.inputs.word;
        let changed = before ^ word;
        if changed == 0 {
            return;
        }
        self.out.inputs.word = word;
        self.out.inputs.count_rising(word & !before);
        if changed & EXPOSURE_MASK != 0 && self.board.capabilities & Capabilities::EXPOSURE_ACTIVE != 0 {
            self.out.exposures(tick, changed);
        }
        if let Some((player, true)) = &mut self.player {
            for (input, rising) in trigger_edges(before, word) {
                if !player.trigger(tick, input, rising, &self.out) && rising {
                    self.out.inputs.miss(input);
                }
            }
            player.look_again(tick, &self.out);
            if changed & word & LIMIT_MASK != 0
                && let Some(axis) = player.blocked(&self.out)
            {
                let tick = self.out.earliest_safe(tick.max(self.out.last()));
                return self.halt(FaultCause::LimitSwitch { axis }, tick, sink);
            }
        }
        if changed & INTERLOCK != 0 && word & INTERLOCK == 0 && self.has_interlock() {
            self.interlock_opened(tick, sink);
        }
        // What the change allows may be due at once.
        self.play(tick, sink);
    }

    fn has_interlock(&self) -> bool {
        self.board.capabilities & Capabilities::INTERLOCK != 0
    }

    fn is_interlocked(&self) -> bool {
        self.has_interlock() && self.out.inputs.word & INTERLOCK == 0
    }

    fn interlock_opened(&mut self, tick: u64, sink: &mut dyn Sink) {
        match (&mut self.player, self.state) {
            (Some((player, _)), _) => {
                let reaction = player.policy().interlock;
                let mut stage =
                    Stage { board: &self.board, out: &mut self.out, sink, host: self.host, blind: false };
                let progress = player.react(tick, FaultCause::Interlock, reaction, &mut stage);
                self.conclude(progress, sink);
            }
            (None, State::Armed) => self.fail(FaultCause::Interlock, tick.max(self.out.last()), sink),
            (None, _) => {}
        }
    }

    /// Tick of the next thing to be done while a program runs: an output, an event, or the end of
    /// an instruction. `None` if there is none before an input changes, or no program runs.
    pub fn next_due(&self) -> Option<u64> {
        match &self.player {
            Some((_, false)) => Some(self.start),
            Some((player, true)) => player.due(&self.out, self.host),
            None => None,
        }
    }

    fn end(&mut self, tick: u64, sink: &mut dyn Sink) {
        self.out.make_safe(tick, &self.board, sink);
        self.out.end_exposures(tick, EXPOSURE_GRACE);
        self.stream_ended(tick);
        let (words, events) = (self.out.words, self.out.events.wrapping_add(1));
        self.out.note(tick, EventKind::RunDone { run: self.run, words, events });
        self.player = None;
        self.state = self.at_rest();
    }

    fn fail(&mut self, cause: FaultCause, tick: u64, sink: &mut dyn Sink) {
        let instruction = self.instruction();
        self.out.make_safe(tick, &self.board, sink);
        // An axis with a home switch that was stopped at speed has to look for it again.
        if let Some((player, _)) = &self.player {
            let mut moving = 0u8;
            for axis in player.moving_axes() {
                moving |= crate::outputs::axis_bit(axis);
            }
            for (axis, limits) in (0u8..).zip(&self.board.axes) {
                if moving & crate::outputs::axis_bit(axis) != 0 && limits.home.is_some() {
                    self.out.set_homed(axis, false);
                }
            }
        }
        self.out.end_exposures(tick, EXPOSURE_GRACE);
        self.stream_ended(tick);
        self.out.note(tick, EventKind::Faulted { cause, instruction });
        self.player = None;
        self.fault = Some(Fault { cause, tick, instruction });
        self.state = State::Faulted;
    }

    fn stream_ended(&mut self, tick: u64) {
        self.last_stream = self.stream().or(self.last_stream);
        if let Some(ticks) = self.loader.stream().map(|s| s.min_lead()) {
            self.out.note(tick, EventKind::StreamLead { ticks });
            self.loader.end_stream();
        }
    }

    fn at_rest(&self) -> State {
        if self.loader.hash().is_some() { State::Loaded } else { State::Empty }
    }

    /// Starts the program that a slot holds, as it is done at power-up.
    ///
    /// # Errors
    /// As `SlotLoad`, `Arm` and `Start` one after the other.
    pub fn autostart(&mut self, now: u64, slot: u8, sink: &mut dyn Sink) -> Result<(), Refusal> {
        self.now = self.now.max(now);
        if !matches!(self.state, State::Empty | State::Loaded) {
            return self.wrong_state();
        }
        self.may_start()?;
        // A host that has left half a program behind must not keep the box from working by itself.
        self.loader.abort();
        self.slot_load(slot, sink)?;
        let hash = self.loader.hash().unwrap_or(0);
        let started = self.arm(hash).and_then(|()| self.start());
        if started.is_err() {
            self.disarm();
        }
        started
    }

    fn instruction(&self) -> u16 {
        self.player.as_ref().map_or(0, |(player, _)| u16::try_from(player.index()).unwrap_or(u16::MAX))
    }

    #[inline(never)]
    fn answer(
        &mut self,
        now: u64,
        id: u32,
        crc: u32,
        request: &Request,
        sink: &mut dyn Sink,
        reply: &mut dyn FnMut(&[u8]),
    ) {
        // `Hello` is answered whatever its id: a new host must always get through.
        let seen = if *request == Request::Hello { Seen::No } else { self.replies.seen(id, crc) };
        match seen {
            Seen::Repeat(frame) => reply(frame),
            Seen::IdReused => {
                if let Ok(frame) = encode_reply(id, &Reply::Refused(Refusal::IdReused)) {
                    reply(&frame);
                }
            }
            Seen::No => {
                // Only a list of events can be too long for a frame.
                if let Ok(frame) = self.carry_out(now, id, request, sink) {
                    self.replies.keep(id, crc, request, &frame);
                    reply(&frame);
                }
            }
        }
    }

    #[inline(never)]
    fn carry_out(
        &mut self,
        now: u64,
        id: u32,
        request: &Request,
        sink: &mut dyn Sink,
    ) -> Result<FrameBytes, TooLarge> {
        let done = match request {
            Request::Hello => return encode_reply(id, &Reply::Hello(self.hello())),
            Request::Status => return encode_reply(id, &Reply::Status(self.status())),
            Request::Clock => return encode_reply(id, &Reply::Clock { tick: now }),
            Request::ReadEvents { from } => return self.events(id, *from),
            Request::StreamStatus => {
                // Of one that has ended, how far it came.
                let state = self.stream().or(self.last_stream).map(Reply::Stream);
                let none = Reply::Refused(Refusal::NotStreaming);
                return encode_reply(id, &state.unwrap_or(none));
            }
            Request::Inputs => return encode_reply(id, &Reply::Inputs(self.input_counts())),
            Request::Slots => return encode_reply(id, &Reply::Slots(sink.slots())),
            Request::Health => return encode_reply(id, &Reply::Health(self.health)),
            Request::SelfTest => return encode_reply(id, &self.self_test(sink)),
            Request::StreamBegin => {
                let begun = self.stream_begin();
                return self.stream_reply(id, begun);
            }
            Request::StreamWrite { offset, data } => {
                let played = self.player.is_some().then(|| self.played());
                let written = self.loader.write_stream(*offset, data, &self.board, played);
                return self.stream_reply(id, written);
            }
            Request::StreamEnd { length, hash } => {
                let ended = self.loader.close_stream(*length, *hash);
                return self.stream_reply(id, ended);
            }
            Request::SlotStore { slot, autostart } => self.slot_store(*slot, *autostart, sink),
            Request::SlotLoad { slot } => self.slot_load(*slot, sink),
            Request::SlotErase { slot } => match self.player {
                Some(_) => self.wrong_state(),
                None => sink.erase(*slot).map_err(|error| Refusal::Slot { slot: *slot, error }),
            },
            Request::LoadBegin { length } => self.load_begin(*length),
            Request::LoadChunk { index, data } => self.loader.chunk(*index, data),
            Request::LoadCommit { length, hash } => self.commit(*length, *hash),
            Request::LoadAbort => {
                self.loader.abort();
                Ok(())
            }
            Request::Arm { hash } => self.arm(*hash),
            Request::Start => self.start(),
            Request::Stop => self.stop(),
            Request::Abort => {
                self.abort(sink);
                Ok(())
            }
            Request::ClearFault => self.clear_fault(),
        };
        encode_reply(
            id,
            &match done {
                Ok(()) => Reply::Done { state: self.state },
                Err(refusal) => Reply::Refused(refusal),
            },
        )
    }

    fn hello(&self) -> Hello {
        let mut board = heapless::String::new();
        // As many characters as fit.
        let _ = self.board.name.chars().try_for_each(|c| board.push(c));
        Hello {
            magic: Hello::MAGIC,
            protocol: PROTOCOL_VERSION,
            schema: SCHEMA_HASH,
            firmware: heapless::String::try_from(env!("CARGO_PKG_VERSION")).unwrap_or_default(),
            board,
            boot_id: self.boot_id,
            tick_hz: TICK_HZ,
            capabilities: self.board.capabilities & PLAYED,
            leds: u8::try_from(self.board.leds.len()).unwrap_or(u8::MAX),
            cameras: self.board.cameras,
            axes: u8::try_from(self.board.axes.len()).unwrap_or(u8::MAX),
            inputs: self.board.inputs,
            max_program_bytes: MAX_PROGRAM_BYTES as u32,
            max_instructions: MAX_INSTRUCTIONS as u16,
            event_ring: EVENT_RING as u16,
            min_step_ticks: MIN_STEP_TICKS,
        }
    }

    fn status(&self) -> Status {
        Status {
            state: self.state,
            tick: self.now,
            boot_id: self.boot_id,
            program: self.loader.hash(),
            position: self.out.position(),
            next_event: self.out.log.next(),
            run: self.run,
            instruction: self.instruction(),
            fault: self.fault,
            rejected: self.decoder.rejected,
        }
    }

    /// As many events as fit a frame: all that are asked for, but for absurdly long numbers.
    fn events(&mut self, id: u32, from: u32) -> Result<FrameBytes, TooLarge> {
        let mut limit = EVENTS_PER_REPLY;
        loop {
            let reply = Reply::Events(self.out.log.read(from, limit));
            match encode_reply(id, &reply) {
                Err(TooLarge) if limit > 1 => limit = limit.saturating_sub(1),
                frame => {
                    if let Reply::Events(events) = &reply {
                        self.out.log.mark_read(events);
                    }
                    return frame;
                }
            }
        }
    }

    fn wrong_state(&self) -> Result<(), Refusal> {
        Err(Refusal::WrongState { state: self.state })
    }

    /// Ticks of the program that have been played: the run so far without the time spent waiting.
    fn played(&self) -> u64 {
        let waited = self.player.as_ref().map_or(0, |(player, _)| player.waited(self.now));
        self.now.saturating_sub(self.start).saturating_sub(waited)
    }

    fn stream_reply(&self, id: u32, done: Result<(), Refusal>) -> Result<FrameBytes, TooLarge> {
        let reply = match done.and_then(|()| self.stream().ok_or(Refusal::NotStreaming)) {
            Ok(state) => Reply::Stream(state),
            Err(refusal) => Reply::Refused(refusal),
        };
        encode_reply(id, &reply)
    }

    #[inline(never)]
    fn stream_begin(&mut self) -> Result<(), Refusal> {
        match self.state {
            State::Running | State::Faulted => self.wrong_state(),
            State::Empty | State::Loaded | State::Armed => {
                if self.board.capabilities & Capabilities::STREAMING == 0 {
                    return Err(Refusal::NotStreaming);
                }
                let position = self.out.position().map(|p| (p, p));
                let checker = Checker::new(Choice::Both, position).strict();
                self.loader.begin_stream(checker, self.out.homed());
                self.state = State::Armed;
                Ok(())
            }
        }
    }

    fn input_counts(&self) -> Inputs {
        let inputs = &self.out.inputs;
        Inputs { word: inputs.word, rising: inputs.rising, missed: inputs.missed, homed: self.out.homed() }
    }

    fn self_test(&self, sink: &mut dyn Sink) -> Reply {
        if self.player.is_some() {
            return Reply::Refused(Refusal::WrongState { state: self.state });
        }
        let own = self_test::run(self.loader.program(), self.loader.hash(), self.out.word);
        let board = sink.self_test();
        Reply::SelfTest(SelfTest { made: own.made | board.made, failed: own.failed | board.failed })
    }

    fn slot_store(&mut self, slot: u8, autostart: Autostart, sink: &mut dyn Sink) -> Result<(), Refusal> {
        if self.player.is_some() || self.loader.hash().is_none() {
            return self.wrong_state();
        }
        if let Autostart::Input { input } = autostart
            && input >= self.board.inputs
        {
            let (value, limit) = (i64::from(input), i64::from(self.board.inputs));
            return Err(Refusal::Invalid(violation(0, Rule::NoSuchInput, value, limit)));
        }
        sink.store(slot, self.loader.program(), autostart).map_err(|error| Refusal::Slot { slot, error })
    }

    fn slot_load(&mut self, slot: u8, sink: &mut dyn Sink) -> Result<(), Refusal> {
        match self.state {
            // What is being loaded would be lost, whatever the slot holds.
            State::Empty | State::Loaded if !self.loader.is_staging() => {
                let fetch = |program: &mut ProgramBytes| {
                    sink.fetch(slot, program).map_err(|error| Refusal::Slot { slot, error })
                };
                self.loader.take(&self.board, fetch)?;
                self.state = State::Loaded;
                Ok(())
            }
            _ => self.wrong_state(),
        }
    }

    /// A stream that waits to be started makes way; one that is played does not.
    fn load_begin(&mut self, length: u32) -> Result<(), Refusal> {
        let streams = self.loader.stream().is_some();
        if streams && self.player.is_some() {
            return self.wrong_state();
        }
        self.loader.begin(length)?;
        if streams {
            self.state = self.at_rest();
        }
        Ok(())
    }

    fn commit(&mut self, length: u32, hash: u32) -> Result<(), Refusal> {
        match self.state {
            State::Empty | State::Loaded | State::Armed => {
                self.loader.commit(length, hash, &self.board)?;
                self.state = State::Loaded;
                Ok(())
            }
            State::Running | State::Faulted => self.wrong_state(),
        }
    }

    fn arm(&mut self, given: u32) -> Result<(), Refusal> {
        match (self.state, self.loader.hash()) {
            (State::Loaded | State::Armed, Some(computed)) if computed != given => {
                Err(Refusal::HashDiffers { computed, given })
            }
            _ if self.loader.stream().is_some() => self.wrong_state(),
            (State::Loaded | State::Armed, Some(_)) => {
                self.state = State::Armed;
                Ok(())
            }
            _ => self.wrong_state(),
        }
    }

    #[inline(never)]
    fn start(&mut self) -> Result<(), Refusal> {
        if self.state != State::Armed {
            return self.wrong_state();
        }
        if self.loader.stream().is_some_and(|s| s.is_empty()) {
            return Err(Refusal::StreamEnded { length: 0 });
        }
        let start = self.may_start()?;
        if let Some(axis) = self.not_homed() {
            return Err(Refusal::NotHomed { axis });
        }
        self.start = start;
        self.horizon = 0;
        self.host_lost = false;
        self.player = Some((Player::new(start, self.board.input_latency), false));
        self.run = self.run.wrapping_add(1);
        self.state = State::Running;
        Ok(())
    }

    /// When a run could begin, if anything could begin now.
    fn may_start(&self) -> Result<u64, Refusal> {
        if self.is_interlocked() {
            return Err(Refusal::InterlockOpen);
        }
        let start = self.now.max(self.out.last()).saturating_add(self.board.start_lead);
        // The proof begins with nothing owed.
        match self.out.owed(start) {
            Some((ticks, led)) => Err(Refusal::Cooling { led, ticks }),
            None => Ok(start),
        }
    }

    /// An axis that the program moves before it has been homed. Streams are looked at as they come.
    fn not_homed(&self) -> Option<u8> {
        if self.loader.stream().is_some()
            || (0u8..).zip(&self.board.axes).all(|(axis, _)| self.out.is_homed(axis))
        {
            return None;
        }
        let mut homed = self.out.homed();
        let mut program = decode(self.loader.program());
        program.find_map(|(_, instruction)| unhomed(&mut homed, &instruction.ok()?))
    }

    fn stop(&mut self) -> Result<(), Refusal> {
        match (self.state, &mut self.player) {
            (State::Running, Some((player, _))) => player.stop(self.now.max(self.horizon)),
            (State::Armed, _) => self.disarm(),
            _ => return self.wrong_state(),
        }
        Ok(())
    }

    fn abort(&mut self, sink: &mut dyn Sink) {
        match self.state {
            State::Running => {
                let tick = self.out.earliest_safe(self.now.max(self.out.last()));
                self.halt(FaultCause::Aborted, tick, sink);
            }
            State::Armed => self.disarm(),
            State::Empty | State::Loaded | State::Faulted => {}
        }
    }

    fn disarm(&mut self) {
        self.loader.end_stream();
        self.state = self.at_rest();
    }

    fn clear_fault(&mut self) -> Result<(), Refusal> {
        if self.state != State::Faulted {
            return self.wrong_state();
        }
        if self.is_interlocked() {
            return Err(Refusal::InterlockOpen);
        }
        self.fault = None;
        self.state = self.at_rest();
        Ok(())
    }
}
