//! A controller to talk to without hardware: the simulated one in real time, its serial line on a TCP port
//! or a pseudo-terminal.
//!
//! Bytes go both ways as they are, at the speed of the simulated line. What a client sends is passed on in
//! whole frames, so that it and a script that drives the robot can share the line.

use crate::fault::Faults;
use crate::mcu::uart::UartEnd;
use crate::run::host::{Counts, Host, Laptop};
use crate::run::scenario::Scenario;
use crate::run::store::Store;
use crate::run::summary::Summary;
use crate::run::{RunError, with};
use embedded_io::ReadReady;
use firmware_core::control_loop::Frame;
use firmware_core::link::MAX_FRAME;
use firmware_core::model::Model;
use std::fs::File;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Bytes that wait for a client that is slow to read; what does not fit is lost, as on a real line.
const MOST_WAITING: usize = 1 << 16;

/// Where clients come in.
#[derive(Debug)]
pub enum Door {
    /// A TCP port; one client at a time.
    Tcp(TcpListener),
    /// A pseudo-terminal.
    #[cfg(unix)]
    Pty(Pty),
}

/// A pseudo-terminal: our end of it, and the other one, held open so that a client may come and go.
#[cfg(unix)]
#[derive(Debug)]
pub struct Pty {
    ours: File,
    _theirs: File,
    path: PathBuf,
}

impl Door {
    /// A TCP port of this machine; port 0 is a free one.
    ///
    /// # Errors
    /// When it cannot be had.
    pub fn tcp(address: SocketAddr) -> io::Result<Self> {
        let listener = TcpListener::bind(address)?;
        listener.set_nonblocking(true)?;
        Ok(Self::Tcp(listener))
    }

    /// A new pseudo-terminal.
    ///
    /// # Errors
    /// When there is none.
    #[cfg(unix)]
    pub fn pty() -> io::Result<Self> {
        use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
        use rustix::termios::{OptionalActions, tcgetattr, tcsetattr};
        let ours = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY)?;
        grantpt(&ours)?;
        unlockpt(&ours)?;
        let name = ptsname(&ours, Vec::new())?.into_string().map_err(io::Error::other)?;
        let path = PathBuf::from(name);
        let theirs = File::options().read(true).write(true).open(&path)?;
        // Bytes as they are: no echo, no line ends, no control characters.
        let mut mode = tcgetattr(&theirs)?;
        mode.make_raw();
        tcsetattr(&theirs, OptionalActions::Now, &mode)?;
        rustix::io::ioctl_fionbio(&ours, true)?;
        Ok(Self::Pty(Pty { ours: File::from(ours), _theirs: theirs, path }))
    }

    /// What a client gives as its port.
    ///
    /// # Errors
    /// When the socket has lost its address.
    pub fn name(&self) -> io::Result<String> {
        match self {
            Self::Tcp(listener) => Ok(format!("tcp:{}", listener.local_addr()?)),
            #[cfg(unix)]
            Self::Pty(pty) => Ok(pty.path.display().to_string()),
        }
    }
}

/// The client at the other end of the line, of which we hold `end`.
pub(crate) struct Remote<E> {
    end: E,
    door: Door,
    client: Option<TcpStream>,
    /// A frame that the client has not sent to its end.
    incoming: Vec<u8>,
    outgoing: Vec<u8>,
    host: Host,
    drives: bool,
    began: Instant,
    speed: f64,
}

impl<E: embedded_io::Read + ReadReady + embedded_io::Write> Remote<E> {
    /// A client at the door. With `drives`, the host's script drives the robot.
    pub(crate) fn new(end: E, door: Door, host: Host, (drives, speed): (bool, f64)) -> Self {
        let (incoming, outgoing, began) = (Vec::new(), Vec::new(), Instant::now());
        Self { end, door, client: None, incoming, outgoing, host, drives, began, speed }
    }

    /// Our end of the line.
    pub(crate) fn end(&mut self) -> &mut E {
        &mut self.end
    }

    /// Passes bytes on, both ways, as far as the client goes along.
    fn exchange(&mut self) {
        if let (Door::Tcp(listener), None) = (&self.door, &self.client)
            && let Ok((stream, _)) = listener.accept()
            && stream.set_nonblocking(true).is_ok()
        {
            // Small frames at once; a client that cannot have that still gets them.
            let _ = stream.set_nodelay(true);
            self.client = Some(stream);
            // Nobody has missed what was said before.
            self.outgoing.clear();
            self.incoming.clear();
        }
        let mut bytes = [0; 1024];
        let (read, written) = match (&mut self.door, &mut self.client) {
            (Door::Tcp(_), Some(stream)) => (stream.read(&mut bytes), stream.write(&self.outgoing)),
            (Door::Tcp(_), None) => {
                self.outgoing.clear();
                return;
            }
            #[cfg(unix)]
            (Door::Pty(pty), _) => (pty.ours.read(&mut bytes), pty.ours.write(&self.outgoing)),
        };
        let waits =
            |e: &io::Error| matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted);
        match (read, written) {
            (Ok(0), _) => self.client = None,
            (Err(e), _) | (_, Err(e)) if !waits(&e) => self.client = None,
            (read, written) => {
                self.outgoing.drain(..written.unwrap_or(0));
                for byte in &bytes[..read.unwrap_or(0)] {
                    self.incoming.push(*byte);
                    if *byte == 0 || self.incoming.len() > 2 * MAX_FRAME {
                        // A full line is a message lost.
                        let _ = self.end.write(&self.incoming);
                        self.incoming.clear();
                    }
                }
            }
        }
    }
}

impl<E: embedded_io::Read + ReadReady + embedded_io::Write> Laptop for Remote<E> {
    fn turn(
        &mut self,
        now_us: u64,
        frame: &mut dyn FnMut(&Frame) -> io::Result<()>,
    ) -> io::Result<()> {
        if self.speed > 0.0 {
            let due = Duration::try_from_secs_f64(now_us as f64 * 1e-6 / self.speed);
            let due = due.unwrap_or(Duration::MAX);
            std::thread::sleep(due.saturating_sub(self.began.elapsed()));
        }
        let mut bytes = [0; 256];
        while matches!(self.end.read_ready(), Ok(true)) {
            let count = self.end.read(&mut bytes).unwrap_or(0);
            if self.outgoing.len() + count <= MOST_WAITING {
                self.outgoing.extend_from_slice(&bytes[..count]);
            }
            self.host.hear(&bytes[..count], frame)?;
        }
        self.exchange();
        if self.drives {
            self.host.speak(now_us, &mut self.end);
        }
        Ok(())
    }

    fn counts(&self) -> Counts {
        self.host.counts()
    }
}

/// Runs a model's robot for a client at the door, `speed` times as fast as reality (0: as fast as it
/// goes), for as long as the scenario says. With `drives`, its script drives the robot; without, the client
/// has to. The client may install other models in the store, whose factory model this one is.
///
/// # Errors
/// [`RunError`].
pub fn serve(
    model: &Model<'_>,
    scenario: &Scenario,
    seed: u64,
    store: &mut Store,
    door: Door,
    (drives, speed): (bool, f64),
) -> Result<Summary, RunError> {
    let laptop = |end: UartEnd, _: &Faults, host| Remote::new(end, door, host, (drives, speed));
    with(model, scenario, seed, Some(store), laptop, &mut |_| Ok(()))
}
