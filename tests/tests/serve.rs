//! A served controller and those who talk to it.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::path::Path;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use firmware_core::control_loop::{Command, Frame, Mode};
use firmware_core::link::{MAX_FRAME, Message, Received, Receiver, encode};
use firmware_sim::run::log::Logger;
use firmware_sim::run::scenario::Scenario;
use firmware_sim::run::serve::{Door, serve};
use firmware_sim::run::store::Store;
use firmware_sim::run::summary::Summary;
use firmware_sim::run::{self, Blob};
use trainer::edmd;
use trainer::monitor::{Recorder, listen};
use trainer::port::Port;
use trainer::recording::Recording;
use trainer::robot::Robot;
use trainer::trajectory::Logs;

/// Virtual seconds per second: enough for a client to follow at leisure.
const SPEED: f64 = 50.0;

fn models() -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../models")
}

fn blob(name: &str) -> Blob {
    Blob::read(&models().join(name).join("model.bin")).unwrap()
}

fn scenario(limit: f64, seconds: f64) -> Scenario {
    Scenario { seconds, ..Scenario::random(limit) }
}

/// Serves a model in a thread; what a client gives as its port.
fn served(
    name: &str,
    door: Door,
    scenario: Scenario,
    drives: bool,
) -> (String, JoinHandle<Summary>) {
    let (port, blob) = (door.name().unwrap(), blob(name));
    let thread = std::thread::spawn(move || {
        let mut store = Store::new(&blob, None);
        let how = (drives, SPEED);
        serve(&blob.model().unwrap(), &scenario, 7, &mut store, door, how).unwrap()
    });
    (port, thread)
}

fn local() -> Door {
    Door::tcp(([127, 0, 0, 1], 0).into()).unwrap()
}

/// The rows of all logs in a folder, without their times.
fn rows(folder: &Path) -> Vec<String> {
    let mut files: Vec<_> =
        std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    let texts: Vec<String> = files.iter().map(|f| std::fs::read_to_string(f).unwrap()).collect();
    let lines = texts.iter().flat_map(|text| text.lines().skip(1));
    lines.map(|line| line.split_once(',').unwrap().1.to_owned()).collect()
}

/// What a monitor records over the line is what the run itself logs.
#[test]
fn a_recording_over_the_line_is_that_of_the_run() {
    let doors = [local(), Door::pty().unwrap()];
    for (door, (name, limit)) in doors.into_iter().zip([("skid-rosbot", 16.0), ("soft-leg", 12.0)])
    {
        let folder = tempfile::tempdir().unwrap();
        let (logged, recorded) = (folder.path().join("logged"), folder.path().join("recorded"));
        let script = scenario(limit, 60.0);
        let blob = blob(name);
        let model = blob.model().unwrap();
        let mut logger = Logger::new(&logged, model.structure(), None, false).unwrap();
        run::run(&model, &script, 7, &mut |seen| logger.frame(seen.frame)).unwrap();
        logger.finish().unwrap();

        let (port, thread) = served(name, door, script, true);
        let robot = Robot::load(&models().join(name)).unwrap();
        let mut line = Port::open(&port, 576_000).unwrap();
        let mut recorder = Recorder::new(&recorded, &robot).unwrap();
        let until = Instant::now() + Duration::from_millis(800);
        let heard = listen(&mut line, &robot, Some(until), &mut |frame| recorder.frame(frame));
        let heard = heard.unwrap();
        drop(line);
        let summary = thread.join().unwrap();
        assert_eq!((heard.lost, heard.strange), (0, 0), "{name}: {heard:?}");
        // A listener that comes late misses what was said before.
        assert!(heard.damaged <= 1 && heard.frames > 100, "{name}: {heard:?}");
        assert_eq!((summary.deadline_misses, summary.driven_at_rest), (0, 0));

        let (all, own) = (rows(&logged), rows(&recorded));
        assert!(own.len() > 100, "{name}: {} rows", own.len());
        assert_eq!(recorder.written(), (1, own.len() as u64));
        assert!(all.windows(own.len()).any(|stretch| stretch == own), "{name}: other rows");
        // The trainer reads it.
        let recording = Recording::open(&recorded).unwrap();
        let fitted =
            edmd::fit(&robot, &Logs { recording: &recording, schema: &robot.schema }, &|_| {});
        assert!(fitted.unwrap().operator.pairs > 90);
        // Nothing is overwritten.
        let message = Recorder::new(&recorded, &robot).unwrap_err().to_string();
        assert!(message.contains("holds episode-000.csv"), "{message}");
    }
}

/// A client by hand.
struct Client {
    stream: TcpStream,
    receiver: Receiver,
}

impl Client {
    fn new(port: &str) -> Self {
        let stream = TcpStream::connect(port.strip_prefix("tcp:").unwrap()).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(20))).unwrap();
        Self { stream, receiver: Receiver::new() }
    }

    fn send(&mut self, message: &Message) {
        let mut bytes = [0; MAX_FRAME];
        let length = encode(message, &mut bytes).unwrap();
        // In two pieces: a network does that.
        let (head, tail) = bytes[..length].split_at(length / 2);
        self.stream.write_all(head).unwrap();
        self.stream.write_all(tail).unwrap();
    }

    fn frames(&mut self) -> Vec<Frame> {
        let mut bytes = [0; 4096];
        let count = self.stream.read(&mut bytes).unwrap_or(0);
        let received = bytes[..count].iter().filter_map(|byte| self.receiver.push(*byte));
        received
            .filter_map(|r| match r {
                Received::Message(Message::Frame(frame)) => Some(frame),
                _ => None,
            })
            .collect()
    }

    /// Waits for a mode, sending `message` again and again.
    fn wait(&mut self, mode: Mode, message: &Message) {
        let began = Instant::now();
        loop {
            self.send(message);
            if self.frames().iter().any(|frame| frame.mode == mode) {
                return;
            }
            assert!(began.elapsed() < Duration::from_secs(10), "never {mode:?}");
        }
    }
}

#[test]
fn a_client_drives_the_robot_and_noise_does_not_stop_it() {
    let (port, thread) = served("skid-rosbot", local(), scenario(16.0, 200.0), false);
    let mut client = Client::new(&port);
    // Nobody drives it: it stays where it is.
    std::thread::sleep(Duration::from_millis(100));
    assert!(client.frames().iter().all(|frame| frame.mode == Mode::Idle));
    client.wait(Mode::Running, &Message::Start);
    // Without commands the watchdog stops it, and only a reset leads out.
    client.wait(Mode::Safe, &Message::Start);
    client.stream.write_all(&[1, 2, 3, 0, 255, 255, 0, 0, 0, 7]).unwrap();
    client.stream.write_all(&[42; 5000]).unwrap();
    client.stream.write_all(&[0]).unwrap();
    client.wait(Mode::Idle, &Message::Reset);
    client.wait(Mode::Running, &Message::Start);
    drop(client);

    // Another client may come after one has gone; it is a stranger to what was said before.
    let mut client = Client::new(&port);
    let inputs = Command::Inputs([8.0, 8.0]).into();
    let began = Instant::now();
    let mut moved = false;
    while !moved && began.elapsed() < Duration::from_secs(10) {
        client.send(&Message::Reset);
        client.send(&Message::Start);
        client.send(&inputs);
        moved = client.frames().iter().any(|frame| {
            frame.mode == Mode::Running && frame.measured.first().is_some_and(|x| *x > 0.3)
        });
    }
    assert!(moved, "it drives ahead");
    drop(client);
    let summary = thread.join().unwrap();
    assert_eq!((summary.deadline_misses, summary.driven_at_rest), (0, 0));
}
