"""Several vehicles in one room: the fleet file, the radio budget, corridors, the order of flight,
and the flight.

The plan is a pure function of the fleet file and the profiles that it names: nothing is connected,
opened or armed. To fly, simulate or draw a fleet:

    fleet = load_fleet("atrium.yaml")   # Fleet; raises NotFound, InvalidValue, one sentence each
    fleet.vehicles                      # FleetVehicle: name, home_m, target_m, and an ordinary
                                        # Profile, with which the vehicle can also fly alone
    plan = make_plan(fleet)             # FleetPlan; raises InvalidValue if it cannot be flown
    plan.fleet                          # the fleet with telemetry periods that fit its dongles
    plan.schedule.groups                # who flies together: (("north", "east"), ("south",))
    plan.schedule.may_fly_together(a, b)
    plan.corridors["north"]             # perchctl.corridor.Corridor, in the room's axes
    plan.dongles                        # DongleLoad: which vehicles share a Crazyradio
    draw_text(fleet, groups), draw_svg(fleet, groups)
    identify_fleet(plan, scope, ask)    # rows of each vehicle on the floor, by name
    fly_fleet(plan, faults, seed)       # FleetResult of one seed, in lockstep: a unit of work
    fleet_summary(results), fleet_table(results)

A flight consists of one process per vehicle, and a parent process that sends them orders:

    options = flight_options(plan, folder, seed, record)
    with open_radios(plan) as radios:   # a RadioHub for each dongle that several vehicles share
        options = radios.route(options)
        children = {name: VehicleProcess(name, each) for name, each in options.items()}
        coordinator = Coordinator(plan, children, switch)   # an OperatorSwitch
        coordinator.run(until)          # in a thread of its own; or call step() repeatedly
        coordinator.confirm(), .land(name), .views, .has_ended
    read_fleet_folder(folder)           # the results and logs of such a flight

messages: the messages between parent and vehicle. vehicle_process: the vehicle's side.
parent_watch: the operator's commands in it, and landing if the parent is gone. dispatch: who may
take off, who lands, and who is too close, as pure functions. coordinator, children: the parent's
side. prepare: checks before anything starts, and radio hubs. outcome: exit code and ``fleet.json``.
folder: read ``fleet.json`` and the logs.

load: the fleet file, and checks that no two vehicles share anything that must be unique. fleet: the
frozen values. assignment: interchangeable targets. radio: dongles and the radio budget. schedule:
corridors, the profiles that enforce them, and who flies when. plan: all of this in one call.
drawing: the room from above. identify: check on the floor that vehicle, body, camera and home
belong together. convert: lists of Crazyflies from other programs. lockstep: the simulated flight
of a whole fleet. room: what its vehicles share. coroutine: how its flights wait for each other.
results: how they ended.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
