//! Writes the seeds of every target to `corpus/TARGET`, where cargo-fuzz looks for them.

use adit_fuzz::{Target, seeds};

fn main() -> std::io::Result<()> {
    for target in Target::ALL {
        let folder = std::path::Path::new("corpus").join(target.name());
        std::fs::create_dir_all(&folder)?;
        for (index, seed) in seeds::of(target).iter().enumerate() {
            std::fs::write(folder.join(format!("seed_{index}")), seed)?;
        }
    }
    Ok(())
}
