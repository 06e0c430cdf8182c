"""Speed loops with delay, sampling and loss: ``hil analyse speed``, ``hil design speed``, its PID."""
