//! The `adit` program: everything happens in the library.

fn main() -> std::process::ExitCode {
    adit::cli::main()
}
