#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    adit_fuzz::read(adit_fuzz::Target::Ptx, bytes);
});
