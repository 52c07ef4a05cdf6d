//! The command line: one file per subcommand, one line per subcommand in the table below.
//!
//! A subcommand is a module with `Arguments` (clap) and `fn run(arguments, &Console) -> Result`. To add one: a `mod` line,
//! a variant of `Command` whose doc comment is its one-line help, and an arm in `Command::run`.

mod compare_methods;
mod console;
mod drape;
mod exit;
mod explain;
mod flatten;
mod hook;
mod info;
mod jobs;
mod lift;
mod measure;
mod nights;
mod package;
mod planes;
mod read_rate;
mod register;
mod run;
mod run_surface;
mod sheet;
mod unwrap;
mod synth;
mod trace;
mod verify;

pub use console::Console;
pub use exit::{Exit, Failure, Result};

use clap::{Parser, Subcommand};
use std::process::ExitCode;

/// The table of subcommands.
#[derive(Subcommand)]
enum Command {
    /// Turn a tunnel scan into a flat, metric map (the whole pipeline).
    Run(run::Arguments),
    /// Map every scan that arrives in a folder.
    Watch(nights::Watch),
    /// Map a list of scans, one after the other.
    Batch(nights::Batch),
    /// Remove old runs from a folder of runs.
    CleanRuns(nights::Clean),
    /// Tell which stages of a run are up to date, and why the others are not.
    Explain(explain::Arguments),
    /// Tell what is in a scan or mesh file, and what is suspicious about it.
    Info(info::Arguments),
    /// Bring overlapping stations together (fine registration), and tell how well they agree.
    Register(register::Arguments),
    /// Bring what was painted on the map back to the points of the scan.
    Lift(lift::Arguments),
    /// Turn strokes painted on the map into polylines, on the map and in 3D.
    Trace(trace::Arguments),
    /// Put linework of the map on the wall, in 3D.
    Drape(drape::Arguments),
    /// Bring 3D linework onto the map.
    Flatten(flatten::Arguments),
    /// Fit planes to traces, with sets, stereonet and statistics; or draw given planes on the map.
    Planes(planes::Arguments),
    /// Measure the way to the map and back again, from the files of a run alone.
    Verify(verify::Arguments),
    /// Flatten one mesh.
    Unwrap(unwrap::Arguments),
    /// Make a synthetic scan of a tunnel that is known in closed form.
    Synth(synth::Arguments),
    /// Flatten one mesh with every method and compare the maps.
    CompareMethods(compare_methods::Arguments),
    /// Measure on the map and on the surface under it.
    Measure(measure::Arguments),
    /// Print the map at true scale: PDF, SVG or PNG.
    Sheet(sheet::Arguments),
    /// Pack everything that is needed to use the map without Adit.
    Package(package::Arguments),
}

impl Command {
    fn run(self, console: &Console) -> Result {
        match self {
            Command::Run(arguments) => run::run(arguments, console),
            Command::Watch(arguments) => nights::watch(arguments, console),
            Command::Batch(arguments) => nights::batch(arguments, console),
            Command::CleanRuns(arguments) => nights::clean_runs(arguments, console),
            Command::Explain(arguments) => explain::run(arguments, console),
            Command::Info(arguments) => info::run(arguments, console),
            Command::Register(arguments) => register::run(arguments, console),
            Command::Lift(arguments) => lift::run(arguments, console),
            Command::Trace(arguments) => trace::run(arguments, console),
            Command::Drape(arguments) => drape::run(arguments, console),
            Command::Flatten(arguments) => flatten::run(arguments, console),
            Command::Planes(arguments) => planes::run(arguments, console),
            Command::Verify(arguments) => verify::run(arguments, console),
            Command::Unwrap(arguments) => unwrap::run(arguments, console),
            Command::Synth(arguments) => synth::run(arguments, console),
            Command::CompareMethods(arguments) => compare_methods::run(arguments, console),
            Command::Measure(arguments) => measure::run(arguments, console),
            Command::Sheet(arguments) => sheet::run(arguments, console),
            Command::Package(arguments) => package::run(arguments, console),
        }
    }
}

const EXAMPLES: &str = "\
Examples:
  adit run --input scan.laz --out runs/today         a map with everything chosen automatically
  adit run pipelines/quick.toml --out runs/quick     the bundled sample
  adit help run                                      what a subcommand does, with examples

Exit codes:
  0 done   1 internal error   2 usage or pipeline file   3 bad input   4 unsupported input
  5 finished, but a quality limit was broken   6 not enough memory or disk   7 cancelled";

/// Turns laser scans of tunnels into flat, metric maps, and what is drawn on the maps back into the scans.
#[derive(Parser)]
#[command(name = "adit", version, after_help = EXAMPLES, max_term_width = 110, arg_required_else_help = true)]
struct CommandLine {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    console: console::Options,
    /// Worker threads (default: one per core). Never changes a result.
    #[arg(long, global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
}

/// The command line of this process: parses the arguments, runs the subcommand, tells the exit code.
pub fn main() -> ExitCode {
    exit::report_panics_as_internal_errors();
    let line = match CommandLine::try_parse() {
        Ok(line) => line,
        Err(error) => {
            // Help and version are no errors. A closed pipe while printing is none either.
            let code = if error.use_stderr() { Exit::Usage } else { Exit::Done };
            let _ = error.print();
            return code.into();
        }
    };
    let console = Console::new(&line.console);
    // Products only appear whole under their final names, so the process may end at any moment.
    let cancelled = ctrlc::set_handler(|| {
        console::to_stderr("cancelled; the same command again goes on from the last finished stage");
        std::process::exit(i32::from(Exit::Cancelled as u8));
    });
    if let Err(error) = cancelled {
        console.warn(&format!("Ctrl-C cannot be handled ({error}); it will end the program without a word"));
    }
    // 0: as many as there are processors.
    let threads = line.threads.map_or(0, usize::from);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build_global();
    if let Err(error) = pool {
        console.error(&format!("cannot start the threads: {error}"));
        return Exit::Resources.into();
    }
    match std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| line.command.run(&console))) {
        Ok(Ok(exit)) => exit.into(),
        Ok(Err(failure)) => {
            console.failure(&failure);
            failure.exit.into()
        }
        // The hook has already told what happened.
        Err(_) => Exit::Internal.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_command_line_is_consistent() {
        CommandLine::command().debug_assert();
    }
}
