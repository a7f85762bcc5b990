//! Requests in, replies out; the state machine.

use crate::Sink;
use crate::board::Board;
use crate::loader::Loader;
use crate::outputs::{AXES, LEDS, Outputs};
use crate::replies::{Replies, Seen};
use crate::timeline::{Player, Progress};
use crate::verifier::PLAYED;
use daic_protocol::frame::{Decoder, Fed, FrameBytes, TooLarge, encode_reply};
use daic_protocol::limits::*;
use daic_protocol::message::*;

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
    now: u64,
    /// Words up to this tick are out of hand.
    horizon: u64,
    health: Health,
}

impl Controller {
    /// A controller just booted: outputs safe, all levels 0, no program, all axes at step 0.
    pub fn new(board: Board, boot_id: u32) -> Self {
        Self {
            board,
            boot_id,
            decoder: Decoder::new(),
            replies: Replies::new(),
            loader: Loader::new(),
            out: Outputs::new(),
            state: State::Empty,
            fault: None,
            run: 0,
            player: None,
            now: 0,
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
                self.answer(now, id, crc, &message, sink, reply);
            }
        }
    }

    /// The link was opened anew: forget a frame that has begun. Counters and replies stay.
    pub fn link_restarted(&mut self) {
        self.decoder.restart();
    }

    /// Plays everything due up to and including tick `until`.
    pub fn play(&mut self, until: u64, sink: &mut dyn Sink) {
        self.now = self.now.max(until);
        let Some((player, begun)) = &mut self.player else { return };
        if !*begun {
            let start = player.due();
            if start > until {
                return;
            }
            *begun = true;
            (self.out.words, self.out.events) = (0, 0);
            let program = self.loader.hash().unwrap_or(0);
            self.out.note(start, EventKind::RunStarted { run: self.run, program });
        }
        match player.play(until, self.loader.program(), &mut self.out, sink) {
            Progress::Waiting(_) => {}
            Progress::Ended(tick) => self.end(tick, sink),
            Progress::Broken => {
                let tick = self.out.earliest_safe(self.out.last());
                self.fail(FaultCause::Internal, tick, sink);
            }
        }
    }

    /// Tick of the next thing to be done while a program runs: an output, an event, or the end of
    /// an instruction.
    pub fn next_due(&self) -> Option<u64> {
        self.player.as_ref().map(|(player, _)| player.due())
    }

    /// A player in hardware has been given everything before `tick`: `Stop` ends the run with the
    /// instruction that is current then.
    pub fn committed(&mut self, tick: u64) {
        self.horizon = tick;
    }

    /// The outputs have gone safe at `tick` without being told to; a run that is under way ends.
    pub fn trip(&mut self, cause: FaultCause, tick: u64, sink: &mut dyn Sink) {
        if self.state == State::Running {
            self.play(tick.saturating_sub(1), sink);
        }
        if self.state == State::Running {
            self.fail(cause, tick, sink);
        }
    }

    /// What the board tells about itself in `Health`.
    pub fn set_health(&mut self, health: Health) {
        self.health = health;
    }

    pub(crate) fn cursor(&self) -> Option<(&Player, &Outputs)> {
        self.player.as_ref().map(|(player, _)| (player, &self.out))
    }

    pub(crate) fn program_bytes(&self) -> &[u8] {
        self.loader.program()
    }

    pub(crate) fn stop_from(&self) -> Option<u64> {
        self.player.as_ref().and_then(|(player, _)| player.stop_from())
    }

    fn end(&mut self, tick: u64, sink: &mut dyn Sink) {
        self.out.make_safe(tick, sink);
        let (words, events) = (self.out.words, self.out.events.wrapping_add(1));
        self.out.note(tick, EventKind::RunDone { run: self.run, words, events });
        self.player = None;
        self.state = State::Loaded;
    }

    fn fail(&mut self, cause: FaultCause, tick: u64, sink: &mut dyn Sink) {
        let instruction = self.instruction();
        self.out.make_safe(tick, sink);
        self.out.note(tick, EventKind::Faulted { cause, instruction });
        self.player = None;
        self.fault = Some(Fault { cause, tick, instruction });
        self.state = State::Faulted;
    }

    fn instruction(&self) -> u16 {
        self.player.as_ref().map_or(0, |(player, _)| player.index())
    }

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
            Request::Health => return encode_reply(id, &Reply::Health(self.health)),
            Request::ReadEvents { from } => return self.events(id, *from),
            Request::LoadBegin { length } => self.loader.begin(*length),
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
            inputs: 0,
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
            (State::Loaded | State::Armed, Some(_)) => {
                self.state = State::Armed;
                Ok(())
            }
            _ => self.wrong_state(),
        }
    }

    fn start(&mut self) -> Result<(), Refusal> {
        if self.state != State::Armed {
            return self.wrong_state();
        }
        let start = self.now.max(self.out.last()).saturating_add(self.board.start_lead);
        self.player = Some((Player::new(start), false));
        self.run = self.run.wrapping_add(1);
        self.state = State::Running;
        Ok(())
    }

    fn stop(&mut self) -> Result<(), Refusal> {
        match (self.state, &mut self.player) {
            (State::Running, Some((player, _))) => player.stop(self.now.max(self.horizon)),
            (State::Armed, _) => self.state = State::Loaded,
            _ => return self.wrong_state(),
        }
        Ok(())
    }

    fn abort(&mut self, sink: &mut dyn Sink) {
        match self.state {
            State::Running => {
                let tick = self.out.earliest_safe(self.now.max(self.out.last()));
                let halted = sink.halt(tick);
                if halted > tick {
                    // What came out until then has happened.
                    self.trip(FaultCause::Aborted, halted, sink);
                } else {
                    self.fail(FaultCause::Aborted, tick, sink);
                }
            }
            State::Armed => self.state = State::Loaded,
            State::Empty | State::Loaded | State::Faulted => {}
        }
    }

    fn clear_fault(&mut self) -> Result<(), Refusal> {
        if self.state != State::Faulted {
            return self.wrong_state();
        }
        self.fault = None;
        self.state = if self.loader.hash().is_some() { State::Loaded } else { State::Empty };
        Ok(())
    }
}
