//! How much memory both loops with line and updates take at most: all of it is on the stack, which is painted
//! first. They run for some seconds, and are asked for everything that a host may ask for: who they are, a
//! model that is to be installed, a start.
#![no_std]
#![no_main]

use core::convert::Infallible;

use cortex_m_rt::entry;
use cortex_m_semihosting::hprintln;
use embedded_io::{ErrorType, Read, ReadReady, Write, WriteReady};
use firmware_core::control_loop::Command;
use firmware_core::link::{MAX_FRAME, Message, encode};
use firmware_core::slots::{Release, robot};
use firmware_core::update::{Anyone, Ask, MAX_CHUNK, PublicKey, Request, Trust};

// It is run here in its own way.
#[allow(dead_code)]
#[path = "../firmware.rs"]
mod firmware;
// Nothing is counted here.
#[allow(dead_code)]
#[path = "../machine.rs"]
mod machine;
#[path = "../owner.rs"]
mod owner;
#[path = "../vectors.rs"]
mod vectors;

use owner::{KEY, SIGNED};

/// Ticks of a loop.
const TICKS: u32 = 400;
/// Room for all that the host says.
const ROOM: usize = 8 * MAX_FRAME;
#[entry]
fn main() -> ! {
    machine::end(measure().is_some())
}

fn measure() -> Option<()> {
    let anyone = most(Anyone)?;
    let signed = most(PublicKey(KEY))?;
    hprintln!("loops {}", anyone);
    hprintln!("signed {}", signed);
    Some(())
}

/// The larger one of the two robots.
#[inline(never)]
fn most(trust: impl Trust + Copy) -> Option<usize> {
    let of = |name, run: fn(Host<'_>, &mut dyn FnMut() -> bool, &dyn Trust)| {
        let mut said = [0; ROOM];
        let length = script(name, &mut said)?;
        let mut ticks = 0;
        let mut goes_on = || {
            ticks += 1;
            ticks < TICKS
        };
        let host = Host(said.get(..length)?);
        let ((), bytes) = machine::stack(|| run(host, &mut goes_on, &trust));
        (ticks == TICKS).then_some(bytes)
    };
    let rosbot = of("skid-rosbot", |host, goes_on, trust| {
        firmware::rosbot(ByReference(trust), host, goes_on);
    })?;
    let leg = of("soft-leg", |host, goes_on, trust| {
        firmware::leg(ByReference(trust), host, goes_on);
    })?;
    Some(rosbot.max(leg))
}

/// What is trusted, wherever it is.
struct ByReference<'t>(&'t dyn Trust);

impl Trust for ByReference<'_> {
    fn key(&self) -> Option<[u8; 8]> {
        self.0.key()
    }
    fn accepts(&self, statement: &[u8; 64], signature: &[u8]) -> bool {
        self.0.accepts(statement, signature)
    }
}

/// All that the host says, one after the other, in `said`; its length.
fn script(name: &str, said: &mut [u8]) -> Option<usize> {
    let signature = || SIGNED.into_iter().collect();
    let length = MAX_CHUNK as u32;
    let release = Release { length, sha256: [0; 32], sequence: 1, robot: robot(name) };
    let asks = [
        Ask::Hello,
        Ask::Begin { session: 1, release, signature: signature() },
        Ask::Chunk { session: 1, offset: 0, bytes: (0..MAX_CHUNK as u8).collect() },
        Ask::Verify { session: 1 },
        Ask::Confirm { signature: signature() },
    ];
    let requests = (1..).zip(asks).map(|(number, ask)| Message::Request(Request { number, ask }));
    let commands = [Command::Start, Command::Inputs([3.0, 4.0])].map(Message::from);
    let mut length = 0;
    for message in requests.chain(commands) {
        length += encode(&message, said.get_mut(length..)?).ok()?;
    }
    Some(length)
}

/// The line to the host, who says a message at every fortieth tick.
struct Host<'s>(&'s [u8]);

impl ErrorType for Host<'_> {
    type Error = Infallible;
}

impl Read for Host<'_> {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Infallible> {
        let count = self.0.len().min(8).min(bytes.len());
        let (head, rest) = self.0.split_at(count);
        bytes.iter_mut().zip(head).for_each(|(to, byte)| *to = *byte);
        self.0 = rest;
        Ok(count)
    }
}

impl ReadReady for Host<'_> {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(!self.0.is_empty())
    }
}

impl Write for Host<'_> {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        Ok(bytes.len())
    }
    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl WriteReady for Host<'_> {
    fn write_ready(&mut self) -> Result<bool, Infallible> {
        Ok(true)
    }
}
