"""``hil`` without its imports: forked from a process that has made them, for tests that judge no start.

A start of ``hil run`` takes 2.3 s of processor time, nine tenths of them for imports of command and logger.
Here each start is a front (:mod:`tests.warm.front`), a process of 12 ms that can be waited for,
signalled and killed as ``hil`` can. It hands arguments, environment, folder and descriptors to a server
(:mod:`tests.warm.server`), which forks the program.

That a new interpreter finds its way, which children a process has, and what becomes of one that is stopped,
is for real processes to show: ``tests.scenario.processes.HIL``.
"""
