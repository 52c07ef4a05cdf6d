//! Keeps the message of a contained panic off the screen: the error that it becomes says it once.

use std::panic;
use std::sync::Once;
use std::sync::atomic::{AtomicUsize, Ordering};

/// Readers that are running now. Their panics may happen on any thread of the pool.
static CONTAINED: AtomicUsize = AtomicUsize::new(0);
static INSTALL: Once = Once::new();

/// Runs `reader` without the default panic message.
///
/// Installs, once for the process, a hook that is silent for panics of other crates while a reader runs and passes
/// everything else on to the hook that was there before.
pub(super) fn quietly<T>(reader: impl FnOnce() -> T) -> T {
    INSTALL.call_once(|| {
        let before = panic::take_hook();
        panic::set_hook(Box::new(move |info| {
            // This file's own path tells where Adit's sources are, wherever it was built.
            let sources = &file!()[..file!().len() - "io/quiet_panics.rs".len()];
            let ours = info.location().is_some_and(|l| l.file().starts_with(sources) || l.file().starts_with("tests"));
            if ours || CONTAINED.load(Ordering::SeqCst) == 0 {
                before(info);
            }
        }));
    });
    CONTAINED.fetch_add(1, Ordering::SeqCst);
    let result = reader();
    CONTAINED.fetch_sub(1, Ordering::SeqCst);
    result
}
