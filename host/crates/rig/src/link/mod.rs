//! Requests and replies: who is there, did it arrive, did it have its effect.
//!
//! The host chooses the id of every request; a request without a reply is sent again with the
//! *same* id and bytes, and the box answers a repeat from its reply cache, so that a retry never
//! repeats an effect. Opening a port discards what was pending, so the host always asks (`Hello`)
//! and never waits for a banner.

mod error;
mod events;
mod stream;
mod transport;
mod unroll;

pub(crate) use error::state_name;
pub use error::{LinkError, Outcome};
pub use events::EventReader;
pub use stream::StreamSender;
pub use transport::{MAX_WRITE, PipeEnd, StreamTransport, Transport, available_ports, open, pipe};
pub use unroll::Unrolled;

use crate::clock::ClockSample;
use daic_protocol::channels;
use daic_protocol::frame::{self, Decoder, Fed};
use daic_protocol::limits::{CHUNK_LEN, PROTOCOL_VERSION};
use daic_protocol::message::{
    Autostart, Events, Hello, Inputs, Rejected, Reply, Request, SCHEMA_HASH, SelfTest, SlotInfo, State,
    Status, StreamState,
};
use std::io;
use std::time::{Duration, Instant};

/// Between two attempts to open a port again.
const REOPEN_EVERY: Duration = Duration::from_millis(50);

/// How patient the link is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LinkOptions {
    /// Bits per second of a serial port.
    pub baud: u32,
    /// How long to wait for one reply before asking again.
    pub timeout: Duration,
    /// How often to ask, at least once.
    pub attempts: u32,
    /// How long to try to open a port again that was pulled out or whose other end went away; zero: not at all.
    /// The box keeps its events meanwhile, and a request that was under way is asked again under the same id.
    pub reconnect: Duration,
}

impl Default for LinkOptions {
    /// 115 200 Bd, 200 ms, 5 times, 10 s.
    fn default() -> Self {
        Self {
            baud: 115_200,
            timeout: Duration::from_millis(200),
            attempts: 5,
            reconnect: Duration::from_secs(10),
        }
    }
}

/// What happened on a link since it was opened.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LinkStats {
    /// Requests answered.
    pub answered: u64,
    /// Times a request was sent again.
    pub retries: u64,
    /// Times the port was opened again.
    pub reconnects: u64,
    /// Replies that belonged to no open request, such as the second of two after a retry.
    pub stale: u64,
    /// Bytes received.
    pub received_bytes: u64,
    /// Replies rejected, by cause.
    pub rejected: Rejected,
}

/// An open connection to a box that has said who it is.
pub struct Link {
    transport: Box<dyn Transport>,
    port: String,
    /// The transport can be had again by opening the port.
    reopens: bool,
    options: LinkOptions,
    decoder: Decoder,
    hello: Hello,
    next_id: u32,
    stats: LinkStats,
    epoch: Instant,
}

impl std::fmt::Debug for Link {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Link").field("port", &self.port).field("hello", &self.hello).finish_non_exhaustive()
    }
}

/// A reply, and when its request went out and it came in.
struct Exchange {
    reply: Reply,
    sent: Instant,
    received: Instant,
    attempts: u32,
}

impl Link {
    /// Opens `tcp://host:port` or a serial port and asks who is there.
    ///
    /// # Errors
    /// The port cannot be opened ([`open`]), or what answers is not a box this program can use
    /// ([`Link::over`]).
    pub fn open(port: &str, options: LinkOptions) -> Result<Self, LinkError> {
        let mut link = Self::over(open(port, options.baud)?, port, options)?;
        link.reopens = true;
        Ok(link)
    }

    /// Asks over an open transport who is there; `port` names it in errors.
    ///
    /// # Errors
    /// [`LinkError::Silent`], [`LinkError::NotOurs`], [`LinkError::OtherVersion`],
    /// [`LinkError::OtherSchema`], [`LinkError::Disconnected`].
    pub fn over(transport: Box<dyn Transport>, port: &str, options: LinkOptions) -> Result<Self, LinkError> {
        let mut link = Self {
            transport,
            port: port.to_owned(),
            reopens: false,
            options,
            decoder: Decoder::new(),
            hello: nobody(),
            next_id: first_id(),
            stats: LinkStats::default(),
            epoch: Instant::now(),
        };
        // Ends whatever partial frame the box may hold from before.
        let write = link.transport.write(&[0], options.timeout);
        write.map_err(|source| link.disconnected("Hello", false, source))?;
        let hello = match link.exchange(&Request::Hello) {
            Ok(Exchange { reply: Reply::Hello(hello), .. }) => hello,
            Err(LinkError::Silent { .. }) if link.stats.received_bytes > 0 => return Err(link.not_ours()),
            Err(other) => return Err(other),
            Ok(_) => return Err(link.not_ours()),
        };
        if hello.magic != Hello::MAGIC || hello.tick_hz == 0 {
            return Err(link.not_ours());
        }
        if hello.protocol != PROTOCOL_VERSION {
            return Err(LinkError::OtherVersion {
                theirs: hello.protocol,
                ours: PROTOCOL_VERSION,
                firmware: hello.firmware.as_str().to_owned(),
            });
        }
        if hello.schema != SCHEMA_HASH {
            return Err(LinkError::OtherSchema { theirs: hello.schema, ours: SCHEMA_HASH });
        }
        let counts = [
            ("LEDs", hello.leds, channels::LEDS),
            ("cameras", hello.cameras, channels::CAMERAS),
            ("axes", hello.axes, channels::AXES),
            ("inputs", hello.inputs, channels::INPUTS),
        ];
        if let Some(&(what, found, max)) = counts.iter().find(|(_, found, max)| found > max) {
            return Err(LinkError::BadHello { what, found, max });
        }
        link.hello = hello;
        Ok(link)
    }

    /// What the box said about itself when the link was opened.
    pub fn hello(&self) -> &Hello {
        &self.hello
    }
    /// The port, as given.
    pub fn port(&self) -> &str {
        &self.port
    }
    /// Counters since the link was opened.
    pub fn stats(&self) -> LinkStats {
        LinkStats { rejected: self.decoder.rejected, ..self.stats }
    }
    /// Zero of the host times of this link.
    pub fn epoch(&self) -> Instant {
        self.epoch
    }

    /// Sends a request and waits for its reply.
    ///
    /// # Errors
    /// Every [`LinkError`] says by [`LinkError::outcome`] whether the request can have had an
    /// effect. A refusal is an error too.
    pub fn request(&mut self, request: &Request) -> Result<Reply, LinkError> {
        self.timed(request).map(|x| x.reply)
    }

    fn timed(&mut self, request: &Request) -> Result<Exchange, LinkError> {
        let exchange = self.exchange(request)?;
        // A box that was reset has forgotten everything: it refuses what its state does not allow,
        // or it was silent while it booted.
        let suspicious = exchange.attempts > 1 || matches!(exchange.reply, Reply::Refused(_));
        if suspicious && !matches!(request, Request::Hello | Request::Status) {
            self.verify_boot().map_err(|error| match error {
                // What could not be sent is the question after it; the request itself was.
                LinkError::Disconnected { port, source, .. } => {
                    LinkError::Disconnected { port, request: name(request), sent: true, source }
                }
                other => other,
            })?;
        }
        match exchange.reply {
            Reply::Refused(refusal) => Err(LinkError::Refused { request: name(request), refusal }),
            Reply::Hello(ref hello) => self.same_boot(hello.boot_id).map(|()| exchange),
            Reply::Status(ref status) => self.same_boot(status.boot_id).map(|()| exchange),
            _ => Ok(exchange),
        }
    }

    /// Asks again who is there.
    ///
    /// # Errors
    /// [`LinkError::BoardReset`] if it is not the same boot any more.
    pub fn verify_boot(&mut self) -> Result<(), LinkError> {
        match self.exchange(&Request::Hello)?.reply {
            Reply::Hello(hello) => self.same_boot(hello.boot_id),
            other => Err(unexpected(&Request::Hello, &other)),
        }
    }

    fn same_boot(&self, boot_id: u32) -> Result<(), LinkError> {
        if boot_id == self.hello.boot_id {
            Ok(())
        } else {
            Err(LinkError::BoardReset { before: self.hello.boot_id, after: boot_id })
        }
    }

    /// State, position, program, counters.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn status(&mut self) -> Result<Status, LinkError> {
        match self.request(&Request::Status)? {
            Reply::Status(status) => Ok(status),
            other => Err(unexpected(&Request::Status, &other)),
        }
    }

    /// Loads an encoded program: begin, chunks, commit. Loading executes nothing, and the box keeps
    /// its old program until the new one is valid. Returns the program's hash.
    ///
    /// # Errors
    /// [`LinkError::Refused`] with the instruction and the rule it breaks, else as [`Link::request`].
    pub fn load(&mut self, program: &[u8]) -> Result<u32, LinkError> {
        let max = self.hello.max_program_bytes as usize;
        let too_long = LinkError::ProgramTooLong { length: program.len(), max };
        let Ok(length) = u32::try_from(program.len()) else { return Err(too_long) };
        if program.len() > max {
            return Err(too_long);
        }
        self.done(&Request::LoadBegin { length })?;
        for (index, chunk) in (0u16..).zip(program.chunks(CHUNK_LEN)) {
            let data = chunk.iter().copied().collect();
            self.done(&Request::LoadChunk { index, data })?;
        }
        let hash = frame::crc32(program);
        self.done(&Request::LoadCommit { length, hash })?;
        Ok(hash)
    }

    /// Makes the committed program ready.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn arm(&mut self, hash: u32) -> Result<State, LinkError> {
        self.done(&Request::Arm { hash })
    }
    /// Plays the armed program.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn start(&mut self) -> Result<State, LinkError> {
        self.done(&Request::Start)
    }
    /// Ends after the current instruction, outputs safe.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn stop(&mut self) -> Result<State, LinkError> {
        self.done(&Request::Stop)
    }
    /// Outputs safe now; the box is faulted afterwards.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn abort(&mut self) -> Result<State, LinkError> {
        self.done(&Request::Abort)
    }
    /// Leaves the faulted state.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn clear_fault(&mut self) -> Result<State, LinkError> {
        self.done(&Request::ClearFault)
    }

    /// The input word and what was counted on it.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn inputs(&mut self) -> Result<Inputs, LinkError> {
        match self.request(&Request::Inputs)? {
            Reply::Inputs(inputs) => Ok(inputs),
            other => Err(unexpected(&Request::Inputs, &other)),
        }
    }
    /// Keeps the committed program in a slot of the box.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn store(&mut self, slot: u8, autostart: Autostart) -> Result<State, LinkError> {
        self.done(&Request::SlotStore { slot, autostart })
    }
    /// Commits the program of a slot.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn load_slot(&mut self, slot: u8) -> Result<State, LinkError> {
        self.done(&Request::SlotLoad { slot })
    }
    /// Forgets the program of a slot.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn erase(&mut self, slot: u8) -> Result<State, LinkError> {
        self.done(&Request::SlotErase { slot })
    }
    /// What the slots hold, empty ones left out.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn slots(&mut self) -> Result<Vec<SlotInfo>, LinkError> {
        match self.request(&Request::Slots)? {
            Reply::Slots(slots) => Ok(slots.into_iter().collect()),
            other => Err(unexpected(&Request::Slots, &other)),
        }
    }
    /// Lets the box test itself.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn self_test(&mut self) -> Result<SelfTest, LinkError> {
        match self.request(&Request::SelfTest)? {
            Reply::SelfTest(found) => Ok(found),
            other => Err(unexpected(&Request::SelfTest, &other)),
        }
    }

    pub(crate) fn stream(&mut self, request: &Request) -> Result<StreamState, LinkError> {
        match self.request(request)? {
            Reply::Stream(state) => Ok(state),
            other => Err(unexpected(request, &other)),
        }
    }

    /// One reply's worth of events from `from` on; see [`EventReader`] for a stream without gaps.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn read_events(&mut self, from: u32) -> Result<Events, LinkError> {
        let request = Request::ReadEvents { from };
        match self.request(&request)? {
            Reply::Events(events) => Ok(events),
            other => Err(unexpected(&request, &other)),
        }
    }

    /// One clock sample; `None` if the request had to be repeated, because nobody knows which of
    /// its copies the reply belongs to.
    ///
    /// # Errors
    /// As [`Link::request`].
    pub fn clock_sample(&mut self) -> Result<Option<ClockSample>, LinkError> {
        let exchange = self.timed(&Request::Clock)?;
        let Reply::Clock { tick } = exchange.reply else {
            return Err(unexpected(&Request::Clock, &exchange.reply));
        };
        let ns = |t: Instant| {
            i64::try_from(t.saturating_duration_since(self.epoch).as_nanos()).unwrap_or(i64::MAX)
        };
        Ok((exchange.attempts == 1).then(|| ClockSample {
            sent_ns: ns(exchange.sent),
            received_ns: ns(exchange.received),
            tick,
        }))
    }

    fn done(&mut self, request: &Request) -> Result<State, LinkError> {
        match self.request(request)? {
            Reply::Done { state } => Ok(state),
            other => Err(unexpected(request, &other)),
        }
    }

    fn exchange(&mut self, request: &Request) -> Result<Exchange, LinkError> {
        let name = name(request);
        let id = self.next_id;
        self.next_id = self.next_id.wrapping_add(1);
        let bytes = frame::encode_request(id, request).map_err(|_| LinkError::TooLarge { request: name })?;
        let begin = Instant::now();
        let attempts = self.options.attempts.max(1);
        let (mut attempt, mut reopened) = (0, 0);
        while attempt < attempts {
            attempt += 1;
            self.stats.retries += u64::from(attempt + reopened > 1);
            let sent = Instant::now();
            let broken = match self.transport.write(&bytes, self.options.timeout) {
                Ok(()) => match self.reply(id, sent + self.options.timeout) {
                    Ok(Some((reply, received))) => {
                        self.stats.answered += 1;
                        return Ok(Exchange { reply, sent, received, attempts: attempt + reopened });
                    }
                    Ok(None) => None,
                    Err(e) => Some((true, e)),
                },
                // Nobody drains the line: as good as silent.
                Err(e) if e.kind() == io::ErrorKind::TimedOut => None,
                Err(e) => Some((attempt + reopened > 1, e)),
            };
            match broken {
                None => tracing::debug!(port = self.port, request = name, attempt, "no reply"),
                Some((sent, source)) => {
                    let lost = self.disconnected(name, sent, source);
                    self.reopen(begin, lost)?;
                    // The box answers a request that it has seen from memory.
                    (attempt, reopened) = (0, reopened + 1);
                }
            }
        }
        Err(LinkError::Silent {
            port: self.port.clone(),
            request: name,
            after_ms: u64::try_from(begin.elapsed().as_millis()).unwrap_or(u64::MAX),
            attempts,
        })
    }

    /// Opens the port again, for a request that began at `begin`; gives back why it was `lost` if that is not to be had.
    fn reopen(&mut self, begin: Instant, lost: LinkError) -> Result<(), LinkError> {
        loop {
            if !self.reopens || begin.elapsed() >= self.options.reconnect {
                return Err(lost);
            }
            match open(&self.port, self.options.baud) {
                Ok(transport) => {
                    tracing::info!(port = self.port, "connected again");
                    self.transport = transport;
                    let rejected = self.decoder.rejected;
                    self.decoder = Decoder::new();
                    self.decoder.rejected = rejected;
                    self.stats.reconnects += 1;
                    // Ends whatever partial frame the box may hold; if it cannot be written, what follows cannot either.
                    self.transport.write(&[0], self.options.timeout).ok();
                    return Ok(());
                }
                Err(error) => tracing::debug!(port = self.port, %error, "not there yet"),
            }
            std::thread::sleep(REOPEN_EVERY);
        }
    }

    /// Reads until the reply to `id` is there; `None` when `deadline` has passed.
    fn reply(&mut self, id: u32, deadline: Instant) -> io::Result<Option<(Reply, Instant)>> {
        let mut buffer = [0u8; MAX_WRITE];
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let n = self.transport.read(&mut buffer, left)?;
            let received = Instant::now();
            self.stats.received_bytes += n as u64;
            let mut answer = None;
            for &byte in buffer.iter().take(n) {
                if let Fed::Message { id: theirs, message, .. } = self.decoder.feed_reply(byte) {
                    if theirs == id && answer.is_none() {
                        answer = Some(message);
                    } else {
                        self.stats.stale += 1;
                    }
                }
            }
            if let Some(reply) = answer {
                return Ok(Some((reply, received)));
            }
            if received >= deadline {
                return Ok(None);
            }
        }
    }

    fn disconnected(&self, request: &'static str, sent: bool, source: io::Error) -> LinkError {
        LinkError::Disconnected { port: self.port.clone(), request, sent, source }
    }

    fn not_ours(&self) -> LinkError {
        let heard = usize::try_from(self.stats.received_bytes).unwrap_or(usize::MAX);
        LinkError::NotOurs { port: self.port.clone(), heard }
    }
}

/// Before the box has said who it is.
fn nobody() -> Hello {
    Hello {
        magic: 0,
        protocol: 0,
        schema: 0,
        firmware: Default::default(),
        board: Default::default(),
        boot_id: 0,
        tick_hz: 0,
        capabilities: 0,
        leds: 0,
        cameras: 0,
        axes: 0,
        inputs: 0,
        max_program_bytes: 0,
        max_instructions: 0,
        event_ring: 0,
        min_step_ticks: 0,
    }
}

/// Ids start anywhere, so that a reply left over from an earlier session matches no request.
fn first_id() -> u32 {
    use std::hash::{BuildHasher, Hasher};
    std::collections::hash_map::RandomState::new().build_hasher().finish() as u32
}

fn unexpected(request: &Request, reply: &Reply) -> LinkError {
    let reply = match reply {
        Reply::Hello(_) => "Hello",
        Reply::Status(_) => "Status",
        Reply::Done { .. } => "Done",
        Reply::Refused(_) => "Refused",
        Reply::Events(_) => "Events",
        Reply::Clock { .. } => "Clock",
        Reply::Stream(_) => "Stream",
        Reply::Inputs(_) => "Inputs",
        Reply::Slots(_) => "Slots",
        Reply::SelfTest(_) => "SelfTest",
        Reply::Health(_) => "Health",
    };
    LinkError::Unexpected { request: name(request), reply }
}

fn name(request: &Request) -> &'static str {
    match request {
        Request::Hello => "Hello",
        Request::Status => "Status",
        Request::LoadBegin { .. } => "LoadBegin",
        Request::LoadChunk { .. } => "LoadChunk",
        Request::LoadCommit { .. } => "LoadCommit",
        Request::LoadAbort => "LoadAbort",
        Request::Arm { .. } => "Arm",
        Request::Start => "Start",
        Request::Stop => "Stop",
        Request::Abort => "Abort",
        Request::ClearFault => "ClearFault",
        Request::ReadEvents { .. } => "ReadEvents",
        Request::Clock => "Clock",
        Request::StreamBegin => "StreamBegin",
        Request::StreamWrite { .. } => "StreamWrite",
        Request::StreamEnd { .. } => "StreamEnd",
        Request::StreamStatus => "StreamStatus",
        Request::Inputs => "Inputs",
        Request::SlotStore { .. } => "SlotStore",
        Request::SlotLoad { .. } => "SlotLoad",
        Request::SlotErase { .. } => "SlotErase",
        Request::Slots => "Slots",
        Request::SelfTest => "SelfTest",
        Request::Health => "Health",
    }
}
