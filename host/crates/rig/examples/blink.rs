//! Blinks LED 0 of a trigger box, timed to the tick: `blink PORT`.
//!
//! Three groups of flashes of 10, 5 and 2 ms, half a second apart; printed is when the box says that each edge was.

use daic_protocol::channels::led;
use daic_protocol::limits::TICK_HZ;
use daic_protocol::message::{Event, EventKind};
use daic_protocol::program::{Instruction, encode};
use daic_rig::link::{EventReader, Link, LinkOptions};

const MS: u32 = TICK_HZ / 1000;

fn program() -> Vec<Instruction> {
    let mask = led(0).unwrap_or(0);
    let mut program = Vec::new();
    for on in [10, 5, 2] {
        program.push(Instruction::LoopBegin { count: 4 });
        program.push(Instruction::Edge { mask, value: mask, after: 500 * MS });
        program.push(Instruction::Edge { mask, value: 0, after: on * MS });
        program.push(Instruction::LoopEnd);
    }
    program
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let port = std::env::args().nth(1).ok_or("blink PORT")?;
    let mut link = Link::open(&port, LinkOptions::default())?;
    println!("{} with firmware {}", link.hello().board, link.hello().firmware);
    let hash = link.load(&encode(&program())?)?;
    let mut reader = EventReader::new(link.status()?.next_event);
    link.arm(hash)?;
    link.start()?;
    let mut start = 0;
    loop {
        let mut events: Vec<Event> = Vec::new();
        reader.poll(&mut link, &mut events)?;
        for event in events {
            match event.kind {
                EventKind::RunStarted { .. } => start = event.tick,
                EventKind::Edge { word, .. } => {
                    let ms = (event.tick - start) as f64 / f64::from(MS);
                    println!("{ms:>12.6} ms  {}", if word & 1 == 1 { "on" } else { "off" });
                }
                EventKind::RunDone { words, .. } => {
                    println!("done, {words} edges");
                    return Ok(());
                }
                EventKind::Faulted { cause, .. } => {
                    return Err(format!("the box went safe: {cause:?}").into());
                }
                _ => {}
            }
        }
        std::thread::sleep(std::time::Duration::from_millis(50));
    }
}
