//! `trainer flash`: a clock, a line and a bar for [`trainer::flash`].

use std::time::{Duration, Instant};

use indicatif::ProgressBar;
use trainer::flash::{FlashError, Flashing, Options, Phase, Progress};
use trainer::port::Port;
use trainer::signing::SignedRelease;

use crate::{BlobFile, Failure, FlashArgs, bar, print, refused};

/// Longest wait for bytes: the bar goes on turning.
const PATIENCE: Duration = Duration::from_millis(100);
/// Time from one attempt to open a port that went away to the next.
const REOPEN: Duration = Duration::from_millis(200);

pub fn flash(args: &FlashArgs) -> Result<(), Failure> {
    let file = BlobFile::read(&args.model)?;
    let model = firmware_core::parse(file.bytes()).map_err(|e| refused(&args.model, e))?;
    let beside = args.model.with_extension("sig");
    let signature = args.signature.clone().or_else(|| beside.is_file().then_some(beside));
    let read = |path: &_| SignedRelease::read(path, model.structure().robot(), file.bytes());
    let signed = signature.as_deref().map(read).transpose()?;
    let mut session = [0; 4];
    getrandom::fill(&mut session)
        .map_err(|e| format!("the system gives no random numbers: {e}"))?;
    let options = Options {
        session: u32::from_le_bytes(session),
        baud: (!args.port.starts_with("tcp:")).then_some(args.baud),
        dry_run: args.dry_run,
        trial: args.trial,
        stop: args.stop,
    };
    let port = Port::open(&args.port, args.baud)?;
    let mut flashing = Flashing::new(file.bytes(), &model, signed.as_ref(), options);
    let progress = bar("asking", file.bytes().len() as u64);
    let result = run(args, port, &mut flashing, &progress);
    progress.finish_and_clear();
    if args.dry_run {
        print(&flashing.introduction())?;
    }
    result?;
    print(&flashing.summary())
}

fn run(
    args: &FlashArgs,
    port: Port,
    flashing: &mut Flashing<'_>,
    progress: &ProgressBar,
) -> Result<(), Failure> {
    let failed = |message: &dyn std::fmt::Display| Failure(format!("{}: {message}", args.port));
    let began = Instant::now();
    let now_us = || began.elapsed().as_micros() as u64;
    let mut port = Some(port);
    let (mut bytes, mut count, mut out) = ([0; 4096], 0, Vec::new());
    let mut warned = false;
    loop {
        out.clear();
        let polled = flashing.poll(now_us(), &bytes[..count], &mut out);
        count = 0;
        if let Some(warning) = flashing.warning()
            && !std::mem::replace(&mut warned, true)
        {
            progress.suspend(|| eprintln!("warning: {warning}"));
        }
        let Progress { phase, written, next_us, .. } =
            polled.map_err(|e: FlashError| failed(&e))?;
        progress.set_position(written.into());
        progress.set_message(phase.to_string());
        if matches!(phase, Phase::Done(_)) {
            return Ok(());
        }
        let patience = Duration::from_micros(next_us.saturating_sub(now_us())).min(PATIENCE);
        let Some(line) = &mut port else {
            // A port that is part of the controller goes away with it, and comes back.
            std::thread::sleep(REOPEN);
            port = Port::open(&args.port, args.baud).ok();
            continue;
        };
        match line.write_all(&out).and_then(|()| line.read_within(&mut bytes, patience)) {
            Ok(read) => count = read,
            Err(_) if matches!(phase, Phase::Activating | Phase::Restarting) => port = None,
            Err(e) if written == 0 => return Err(failed(&e)),
            Err(e) if matches!(phase, Phase::Trial(_) | Phase::Confirming) => {
                return Err(failed(&format!(
                    "{e}; the model is on trial, and the same command confirms it"
                )));
            }
            Err(e) => {
                return Err(failed(&format!("{e}; the same command goes on at byte {written}")));
            }
        }
    }
}
