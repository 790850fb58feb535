//! Every kernel of the registry, which the first byte chooses, on every instruction set with any shapes and values: the
//! bits of the specification. Tensors are exactly as long as a kernel asks for, so that the sanitizer sees a step beyond
//! either end.

#![no_main]

use libfuzzer_sys::fuzz_target;
use voxcast_kernels::Isa;
use voxcast_kernels::cases::{Draw, Memory, REGISTRY, agree};

fuzz_target!(|bytes: &[u8]| {
    let Some((&first, rest)) = bytes.split_first() else { return };
    let entry = &REGISTRY[usize::from(first) % REGISTRY.len()];
    if let Some(case) = (entry.draw)(&mut Draw::new(rest)) {
        let isas: Vec<_> = Isa::available().collect();
        agree(entry.name, &*case, &isas, &[Memory::Heap]);
    }
});
