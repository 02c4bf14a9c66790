//! The line to a controller: a serial device, a pseudo-terminal, or TCP.

use std::io::{self, ErrorKind, Read, Write};
use std::net::{TcpStream, ToSocketAddrs};
use std::time::Duration;

use serial2::SerialPort;

/// Longest wait for bytes in [`Port::read`]: after it a caller may look at the clock.
const PATIENCE: Duration = Duration::from_millis(100);
/// Longest wait until the line takes bytes.
const WRITE: Duration = Duration::from_secs(2);

/// Why a port cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PortError {
    /// An address that is none.
    #[error("{port}: expected a serial device, or tcp:HOST:PORT")]
    Address {
        /// What was given.
        port: String,
    },
    /// It cannot be opened.
    #[error("{port}: cannot be opened: {error}")]
    Open {
        /// What was given.
        port: String,
        /// Why.
        error: io::Error,
    },
}

/// A line to a controller.
#[derive(Debug)]
pub enum Port {
    /// A serial device, or a pseudo-terminal.
    Serial(SerialPort),
    /// A TCP connection.
    Tcp(TcpStream),
}

impl Port {
    /// Opens `tcp:HOST:PORT`, or the serial device of this name at `baud` bits/s.
    ///
    /// # Errors
    /// [`PortError`].
    pub fn open(port: &str, baud: u32) -> Result<Self, PortError> {
        let open = |error| PortError::Open { port: port.to_owned(), error };
        let Some(address) = port.strip_prefix("tcp:") else {
            let mut line = SerialPort::open(port, baud).map_err(open)?;
            line.set_write_timeout(WRITE).map_err(open)?;
            return Ok(Self::Serial(line));
        };
        let address = address.to_socket_addrs().ok().and_then(|mut found| found.next());
        let address = address.ok_or_else(|| PortError::Address { port: port.to_owned() })?;
        let stream = TcpStream::connect_timeout(&address, Duration::from_secs(5)).map_err(open)?;
        stream.set_write_timeout(Some(WRITE)).map_err(open)?;
        // Requests are short, and each waits for its answer: none may wait for another one.
        stream.set_nodelay(true).map_err(open)?;
        Ok(Self::Tcp(stream))
    }

    /// What has arrived; nothing after a tenth of a second without a byte.
    ///
    /// # Errors
    /// When the line is gone.
    pub fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        self.read_within(bytes, PATIENCE)
    }

    /// What has arrived; nothing after `patience` without a byte (at least a millisecond).
    ///
    /// # Errors
    /// When the line is gone.
    pub fn read_within(&mut self, bytes: &mut [u8], patience: Duration) -> io::Result<usize> {
        let patience = patience.max(Duration::from_millis(1));
        let read = match self {
            Self::Serial(line) => line.set_read_timeout(patience).and_then(|()| line.read(bytes)),
            Self::Tcp(stream) => {
                stream.set_read_timeout(Some(patience)).and_then(|()| stream.read(bytes))
            }
        };
        // A signal is no answer, and no failure.
        let nothing = [ErrorKind::TimedOut, ErrorKind::WouldBlock, ErrorKind::Interrupted];
        match read {
            Ok(0) => Err(io::Error::new(ErrorKind::UnexpectedEof, "the other end has hung up")),
            Err(e) if nothing.contains(&e.kind()) => Ok(0),
            read => read,
        }
    }

    /// Sends bytes.
    ///
    /// # Errors
    /// When the line is gone, or takes nothing for two seconds.
    pub fn write_all(&mut self, bytes: &[u8]) -> io::Result<()> {
        match self {
            Self::Serial(line) => line.write_all(bytes),
            Self::Tcp(stream) => stream.write_all(bytes),
        }
    }
}
