//! Keys, signatures, and a controller behind a TCP port, as a user meets them.

mod command;

use std::cell::RefCell;
use std::collections::VecDeque;
use std::convert::Infallible;
use std::io::{Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::rc::Rc;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use command::{Said, Workshop};
use embedded_io::{Read, ReadReady, Write, WriteReady};
use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash,
};
use firmware_core::control_loop::telemetry::Queue;
use firmware_core::control_loop::{Alarms, Command, ControlLoop, Mode, Supervisor, Timing};
use firmware_core::link::Port;
use firmware_core::slots::Geometry;
use firmware_core::update::{Capacities, Identity, PublicKey, Updater};

/// A workshop with a model.
fn workshop() -> Workshop {
    let workshop = Workshop::new();
    workshop.succeed(&["fit", ".", "--no-score"]);
    workshop
}

fn digits(text: &str) -> bool {
    text.len() == 64 && text.chars().all(|c| matches!(c, '0'..='9' | 'a'..='f'))
}

#[test]
fn keys_are_made_once() {
    let workshop = Workshop::new();
    let text = workshop.succeed(&["keygen", "--out", "owner.v1"]);
    let public = String::from_utf8(workshop.read("owner.v1.pub")).unwrap();
    assert!(digits(public.trim_end()), "{public}");
    let secret = String::from_utf8(workshop.read("owner.v1.key")).unwrap();
    let secret = secret.trim_end().strip_prefix("secret ").unwrap();
    assert!(digits(secret) && !text.contains(secret));
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        let mode = workshop.path("owner.v1.key").metadata().unwrap().permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
    }
    let line = text.lines().find(|line| line.starts_with("PublicKey([0x")).unwrap();
    let bytes: String = line.split("0x").skip(1).map(|byte| &byte[..2]).collect();
    assert_eq!(bytes, public.trim_end());
    assert!(text.trim_end().ends_with(&format!("begins {}", &public[..16])), "{text}");

    for (file, kept) in [("owner.v1.key", "owner.v1.pub"), ("owner.v1.pub", "owner.v1.key")] {
        let message = workshop.refuse(&["keygen", "--out", "owner.v1"]);
        assert!(message.contains("is there already") && message.contains("--out"), "{message}");
        let content = workshop.read(file);
        std::fs::remove_file(workshop.path(file)).unwrap();
        let message = workshop.refuse(&["keygen", "--out", "owner.v1"]);
        assert!(message.starts_with(kept), "{message}");
        workshop.write(file, content);
    }
    let message = workshop.refuse(&["keygen", "--out", "no/owner"]);
    assert!(message.starts_with("no/owner.key: cannot be written"), "{message}");
}

#[test]
fn models_are_signed() {
    let workshop = workshop();
    workshop.succeed(&["keygen", "--out", "owner"]);
    let sign = ["sign", "model.bin", "--key", "owner.key", "--sequence", "7"];
    let text = workshop.succeed(&sign);
    assert!(text.starts_with("model.sig: model.bin, ") && text.contains("as release 7 for `cart`"));
    let signed = workshop.read("model.sig");
    workshop.succeed(&sign);
    workshop.succeed(&[&sign[..], &["--out", "again.sig"]].concat());
    assert!(workshop.read("again.sig") == signed && workshop.read("model.sig") == signed);
    let signed = String::from_utf8(signed).unwrap();
    assert!(signed.contains("robot = \"cart\"\nsequence = 7\n"), "{signed}");
    let public = String::from_utf8(workshop.read("owner.pub")).unwrap();
    assert!(signed.contains(&format!("public_key = \"{}\"", public.trim_end())));

    let refused = |arguments: &[&str], parts: &[&str]| {
        let message = workshop.refuse(&[&["sign", "--sequence", "7"], arguments].concat());
        for part in parts {
            assert!(message.contains(part), "`{part}` is not in: {message}");
        }
    };
    let key = ["--key", "owner.key"];
    refused(&["robot.toml", key[0], key[1]], &["robot.toml: this is not a model blob"]);
    refused(&["nothing.bin", key[0], key[1]], &["nothing.bin: cannot be read"]);
    refused(&["model.bin", "--key", "owner.pub"], &["owner.pub: this is a public key", "NAME.key"]);
    refused(&["model.bin", "--key", "model.bin"], &["model.bin: expected `secret` and 64"]);
    refused(&["model.bin", "--key", "mine.key"], &["mine.key: cannot be read"]);
    let replaces =
        |out| refused(&["model.bin", key[0], key[1], "--out", out], &["give another --out"]);
    replaces("model.bin");
    replaces("owner.key");
    let said = workshop.run(&["sign", "model.bin", "--key", "owner.key"]);
    assert!(said.code == Some(2) && said.stderr.contains("--sequence"), "{said:?}");
}

#[test]
fn signatures_are_looked_at_before_the_port() {
    let workshop = workshop();
    workshop.succeed(&["keygen", "--out", "owner"]);
    workshop.succeed(&["sign", "model.bin", "--key", "owner.key", "--sequence", "7"]);
    let flash = ["flash", "model.bin", "--port", "no/such/port"];
    let message = workshop.refuse(&flash);
    assert!(message.starts_with("no/such/port: cannot be opened: "), "{message}");
    let message = workshop.refuse(&["flash", "model.bin", "--port", "tcp:nowhere"]);
    assert!(message.contains("expected a serial device, or tcp:HOST:PORT"), "{message}");
    let message = workshop.refuse(&[&flash[..], &["--signature", "other.sig"]].concat());
    assert!(message.starts_with("other.sig: cannot be read: "), "{message}");
    let signed = String::from_utf8(workshop.read("model.sig")).unwrap();
    workshop.write("model.sig", signed.replace("sequence = 7", "sequence = 8"));
    let message = workshop.refuse(&flash);
    assert!(message.starts_with("model.sig: the signature to install the model is not"));
    workshop.write("model.sig", "robot = 7");
    let message = workshop.refuse(&flash);
    assert!(message.starts_with("model.sig:1:") && message.contains("`trainer sign`"), "{message}");
    let message = workshop.refuse(&["flash", "robot.toml", "--port", "no"]);
    assert!(message.contains("this is not a model blob"), "{message}");
}

const SECTOR: usize = 8192;

/// Two sectors of memory, written once after each erase.
#[derive(Clone)]
struct Memory(Rc<RefCell<Vec<u8>>>);

#[derive(Debug)]
struct Misuse;

impl NorFlashError for Misuse {
    fn kind(&self) -> NorFlashErrorKind {
        NorFlashErrorKind::Other
    }
}

impl ErrorType for Memory {
    type Error = Misuse;
}

impl ReadNorFlash for Memory {
    const READ_SIZE: usize = 1;

    fn read(&mut self, at: u32, bytes: &mut [u8]) -> Result<(), Misuse> {
        bytes.copy_from_slice(&self.0.borrow()[at as usize..][..bytes.len()]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        2 * SECTOR
    }
}

impl NorFlash for Memory {
    const WRITE_SIZE: usize = 8;
    const ERASE_SIZE: usize = SECTOR;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Misuse> {
        self.0.borrow_mut()[from as usize..to as usize].fill(0xFF);
        Ok(())
    }

    fn write(&mut self, at: u32, bytes: &[u8]) -> Result<(), Misuse> {
        let mut memory = self.0.borrow_mut();
        let place = &mut memory[at as usize..][..bytes.len()];
        let misused = !(at as usize).is_multiple_of(8) || !bytes.len().is_multiple_of(8);
        if misused || place.iter().any(|byte| *byte != 0xFF) {
            return Err(Misuse);
        }
        place.copy_from_slice(bytes);
        Ok(())
    }
}

/// A loop that does nothing but its state machine.
struct Robot(Supervisor);

impl ControlLoop<1> for Robot {
    fn command(&mut self, _: Command<1>) {}

    fn tick(&mut self, _: u64) -> Mode {
        self.mode()
    }

    fn finish(&mut self, _: u64) -> Mode {
        self.mode()
    }

    fn path(&self) -> &[f32] {
        &[]
    }

    fn supervisor(&self) -> &Supervisor {
        &self.0
    }

    fn supervisor_mut(&mut self) -> &mut Supervisor {
        &mut self.0
    }
}

/// A UART that is a connection.
#[derive(Default)]
struct Serial {
    received: VecDeque<u8>,
    sent: Vec<u8>,
}

impl embedded_io::ErrorType for Serial {
    type Error = Infallible;
}

impl Read for Serial {
    fn read(&mut self, bytes: &mut [u8]) -> Result<usize, Infallible> {
        let count = bytes.len().min(self.received.len());
        for (place, byte) in bytes.iter_mut().zip(self.received.drain(..count)) {
            *place = byte;
        }
        Ok(count)
    }
}

impl ReadReady for Serial {
    fn read_ready(&mut self) -> Result<bool, Infallible> {
        Ok(!self.received.is_empty())
    }
}

impl Write for Serial {
    fn write(&mut self, bytes: &[u8]) -> Result<usize, Infallible> {
        self.sent.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<(), Infallible> {
        Ok(())
    }
}

impl WriteReady for Serial {
    fn write_ready(&mut self) -> Result<bool, Infallible> {
        Ok(true)
    }
}

/// A controller of the cart, in a thread; its port is part of it, and is closed while it resets.
struct Controller {
    port: String,
    ends: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Controller {
    fn new(key: Option<PublicKey>) -> Self {
        let listener = TcpListener::bind(("127.0.0.1", 0)).unwrap();
        let address = listener.local_addr().unwrap();
        let ends = Arc::new(AtomicBool::new(false));
        let end = ends.clone();
        let thread = std::thread::spawn(move || {
            let flash = Memory(Rc::new(RefCell::new(vec![0xFF; 2 * SECTOR])));
            let mut listener = Some(listener);
            while !end.load(Ordering::Relaxed) {
                let own = listener.take().unwrap_or_else(|| TcpListener::bind(address).unwrap());
                boot(&flash, key, &own, &end);
                drop(own);
                std::thread::sleep(Duration::from_millis(50));
            }
        });
        Self { port: format!("tcp:{address}"), ends, thread: Some(thread) }
    }
}

impl Drop for Controller {
    fn drop(&mut self) {
        self.ends.store(true, Ordering::Relaxed);
        let _ = self.thread.take().unwrap().join();
    }
}

/// From one reset to the next.
fn boot(flash: &Memory, key: Option<PublicKey>, listener: &TcpListener, end: &AtomicBool) {
    let identity = Identity {
        firmware: "cart 2.1",
        robot: "cart",
        factory: b"factory",
        capacities: Capacities::new::<2, 1>(100_000, 0),
        erase_ms: 100,
        good_ticks: 20,
    };
    let geometry = Geometry { offset: 0, slot_bytes: SECTOR as u32 };
    let booted = Updater::boot(flash.clone(), geometry, identity, 0, key, |_| true);
    let mut updater = booted.unwrap().0;
    let timing = Timing { period_us: 10_000, watchdog_us: 1_000_000 };
    let mut robot = Robot(Supervisor::new(timing));
    let (mut port, mut serial) = (Port::new(), Serial::default());
    let mut queue = Queue::<2>::new();
    let (_, mut frames) = queue.split();
    let began = Instant::now();
    listener.set_nonblocking(true).unwrap();
    let mut stream: Option<TcpStream> = None;
    let mut bytes = [0; 512];
    let mut resets = false;
    while !(resets || end.load(Ordering::Relaxed)) {
        std::thread::sleep(Duration::from_millis(1));
        if let Ok((new, _)) = listener.accept() {
            new.set_nonblocking(true).unwrap();
            stream = Some(new);
        }
        if let Some(stream) = &mut stream
            && let Ok(count) = stream.read(&mut bytes)
        {
            serial.received.extend(&bytes[..count]);
        }
        updater.ticked(Alarms::none());
        let now_us = began.elapsed().as_micros() as u64;
        port.receive(&mut serial, &mut robot, &mut updater, now_us);
        port.send(&mut frames, &mut serial);
        if let Some(stream) = &mut stream {
            let _ = stream.write_all(&serial.sent);
        }
        serial.sent.clear();
        resets = updater.resets() && port.is_sent();
    }
}

#[test]
fn a_model_is_installed_over_a_port() {
    let workshop = workshop();
    workshop.succeed(&["keygen", "--out", "owner"]);
    let public = String::from_utf8(workshop.read("owner.pub")).unwrap();
    let bytes: Vec<u8> =
        (0..32).map(|i| u8::from_str_radix(&public[2 * i..2 * i + 2], 16).unwrap()).collect();
    let controller = Controller::new(Some(PublicKey(bytes.try_into().unwrap())));
    let flash = ["flash", "model.bin", "--port", &controller.port];
    let with = |more: &[&'static str]| [&flash[..], more].concat();

    let message = workshop.refuse(&flash);
    assert!(message.contains(&format!("begins {}", &public[..16])), "{message}");
    assert!(message.contains("`trainer sign`"), "{message}");
    workshop.succeed(&["sign", "model.bin", "--key", "owner.key", "--sequence", "7"]);

    let text = workshop.succeed(&with(&["--dry-run"]));
    for part in [
        "controller  cart 2.1, robot `cart`, idle\n",
        "runs        the model in its firmware (release 0, ",
        &format!(
            "accepts     release 0 and above, signed with the key that begins {}",
            &public[..16]
        ),
        "room        7,872 bytes, 2 states, 1 inputs, a sample of 100 ms\n",
        "fits and may be installed\n",
    ] {
        assert!(text.contains(part), "`{part}` is not in: {text}");
    }
    let text = workshop.succeed(&with(&["--trial"]));
    assert!(text.contains("release 7, ") && text.contains("in slot A, on trial"), "{text}");
    assert!(text.contains("the same command without --trial"), "{text}");
    let text = workshop.succeed(&flash);
    assert!(text.contains("in slot A, confirmed\n") && !text.contains("bytes/s"), "{text}");
    let text = workshop.succeed(&flash);
    assert!(text.contains("runs already: ") && text.contains("nothing to do"), "{text}");

    // All at once, over the other slot.
    workshop.succeed(&["sign", "model.bin", "--key", "owner.key", "--sequence", "9"]);
    let text = workshop.succeed(&flash);
    assert!(text.contains(" bytes/s; ") && text.contains("in slot B, confirmed\n"), "{text}");
    workshop.succeed(&["sign", "model.bin", "--key", "owner.key", "--sequence", "8"]);
    let message = workshop.refuse(&flash);
    assert!(message.starts_with(&controller.port) && message.contains("--sequence 9"), "{message}");
}

#[test]
fn a_controller_that_trusts_everybody_is_warned_of() {
    let workshop = workshop();
    let controller = Controller::new(None);
    let Said { code, stdout, stderr } =
        workshop.run(&["flash", "model.bin", "--port", &controller.port]);
    assert_eq!(code, Some(0), "{stderr}");
    assert!(stdout.contains("release 0, ") && stdout.contains("confirmed"), "{stdout}");
    assert!(stderr.starts_with("warning: the controller trusts everybody"), "{stderr}");
    assert_eq!(stderr.lines().count(), 1);
}
