"""Section IV of the paper on a virtual stand: how truly a part's motions are recognised."""
